"""Hard cases and bit flips against a network and its INT8 file: `beers-deploy stress`.

- `cases` draws the hard cases; `networks` opens the pair and looks at a case at each stage, by the
  `checks`;
- `battery` runs every case through every stage, and returns a table of what held;
- `faults` flips bits and guards against them; `bit_flips` says what flips cost and what the guards
  do.
"""
