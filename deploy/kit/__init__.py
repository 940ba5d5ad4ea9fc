"""The kit that a board's engineer receives.

- `board`: a board, and the folder that is written for it; `board_file`: the core of a network;
- `golden`: what every layer must write; `golden_results`: what a board wrote, compared with that;
- `record`: what a network is, what made it, and what was checked;
- `host_facts`: what `host` must know of a network;
- `host` and `measure` run on the board by themselves, and `readme.md` goes with them.
"""

RECORD = ("record.json", "record.html", "record.cdx.json")
"""The files of a record of evidence."""
