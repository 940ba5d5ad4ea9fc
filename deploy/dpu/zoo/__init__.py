"""Published networks written down from their papers, without weights: what the cost model is fitted on."""
