"""The command line, made from the verbs.

    sensor profile -> simulate -> train -> export -> quantize -> gate -> check -> bench -> restore

- `commands`: which verbs are commands, and the entry of the program
- `generate`: a command of Typer from a verb's signature and docstring
- `run`: a verb is run, its result printed, its errors mapped to exit codes
- `streams`: standard output and error that end no run

Exit codes: 0 done, 1 a gate or a check failed, 2 bad input (one sentence on standard error, nothing
half-written), 70 a fault of this program, 130 interrupted.
"""
