"""Run hard cases and bit flips against a network and its INT8 file: `beers-deploy stress`.

- `cases` draws the hard cases; `networks` opens the pair; `stages` checks a case at each stage, by
  the `checks`;
- `battery` runs every case through every stage, and returns a table of the results;
- `faults` flips bits and guards against them; `bit_flips` reports the cost of flips and the effect
  of the guards.
"""
