"""The errors of layers as node data of Google's Model Explorer, which colours nodes by a value."""

import json
from collections.abc import Iterable

from beers_deploy.profiles.figures import Row

SHARE = "share of squared error"
GRADIENT = [{"stop": 0, "bgColor": "#ffffff"}, {"stop": 1, "bgColor": "#d73027"}]
"""From the smallest value to the largest."""


def node_data(layers: Iterable[Row]) -> str:
    """Return the JSON of one graph: the share of the squared error by the node's name, in percent.

    The nodes of the float network, of the host's and of the board's file have the layers' names.

    Args:
        layers: rows of layers in int8 by themselves; others are left out.
    """
    shares = {row.name: row.figures[SHARE].value for row in layers if SHARE in row.figures}
    results = {name: {"value": share} for name, share in shares.items()}
    return json.dumps({"name": f"{SHARE}, %", "results": results, "gradient": GRADIENT}, indent=1)
