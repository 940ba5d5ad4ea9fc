"""What a board's engineer is handed.

- `golden`: what every layer must write, and what is wrong where one does not;
- `record`: what a network is, what made it, and what was checked;
- `host_facts`: what `host` must know of a network;
- `host` and `measure` run on the board by themselves, and `readme.md` goes with them.
"""
