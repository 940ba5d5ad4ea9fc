"""Hard cases against a network and everything around it: `beers-deploy stress`, docs/stability.md."""
