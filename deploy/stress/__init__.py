"""Hard cases and bit flips against a network and everything around it: `beers-deploy stress`.

docs/explanation/stability.md says what comes out.

- `subject` opens the pair of networks; `cases` lists the hard cases, `images` draws them;
- `networks` and `science` look at a case at one stage; `checks` measures, and knows the limitations;
- `battery` runs every case through every stage, `rows` shows what came out and what is proven;
- `flips` injects bit flips with and without guards (`quant.faults`), `flip_study` makes the tables and their prices.
"""
