"""Machines are shared: no property test is judged by its time."""

from hypothesis import settings

settings.register_profile("project", deadline=None)
settings.load_profile("project")
