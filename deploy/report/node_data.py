"""The errors of layers as node data of Google's Model Explorer, which colours nodes by a value."""

import json
from collections.abc import Iterable

from beers_deploy.profiles.figures import Row

SHARE = "share of squared error"
GRADIENT = [{"stop": 0, "bgColor": "#ffffff"}, {"stop": 1, "bgColor": "#d73027"}]
"""Colours from the smallest value to the largest."""


def node_data(layers: Iterable[Row]) -> str:
    """Return the share of the squared error of each node as JSON of one graph.

    The nodes in the float network, the host's file and the board's file have the layers' names, so
    the same JSON colours all three.

    Args:
        layers: rows with a single layer in int8; other rows are left out.

    Returns:
        JSON text as Model Explorer reads it, with the shares in percent by the node's name.
    """
    shares = {row.name: row.figures[SHARE].value for row in layers if SHARE in row.figures}
    results = {name: {"value": share} for name, share in shares.items()}
    return json.dumps({"name": f"{SHARE}, %", "results": results, "gradient": GRADIENT}, indent=1)
