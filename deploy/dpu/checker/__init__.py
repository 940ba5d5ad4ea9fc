"""Check what the DPU can run: its rules, one small function each, and the device of each node.

- `conv_rules`, `number_rules`, `other_rules`: the rules, whose docstrings are their text;
- `operators`: which rules each operator must keep; `finding`: what breaks one, and the remedy;
- `placement`: each node on the DPU or the CPU, and the subgraphs; `remarks`: what else to know of
  it;
- `table`: all of it as rows.
"""
