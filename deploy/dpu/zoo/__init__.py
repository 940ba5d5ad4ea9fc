"""Published networks as text, without weights, and their published rates: what the cost model is fitted on."""
