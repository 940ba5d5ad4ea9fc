"""A Dask cluster of this machine, for tests that compute on a cluster."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any


@contextmanager
def local_cluster(workers: int = 2) -> Iterator[Any]:
    """Yield a distributed.LocalCluster of `workers` processes with one thread each."""
    no_page = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    options = {
        "processes": True,
        "threads_per_worker": 1,
        "memory_limit": 0,
        "silence_logs": logging.CRITICAL,
    }
    with import_module("distributed").LocalCluster(
        n_workers=workers, **options, **no_page
    ) as local:
        yield local
