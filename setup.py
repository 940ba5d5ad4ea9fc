"""What is installed is one package: `beers_deploy` is deploy/, with model/, quant/ and profiles/ inside it."""

from setuptools import find_namespace_packages, setup

INSIDE = ("model", "quant", "profiles")
folders = find_namespace_packages(include=[f"{name}{end}" for name in ("deploy", *INSIDE) for end in ("", ".*")])


def installed(name: str) -> str:
    """What a folder's package is called where it is installed."""
    return name.replace("deploy", "beers_deploy", 1) if name.startswith("deploy") else f"beers_deploy.{name}"


setup(
    packages=[installed(name) for name in folders],
    package_dir={installed(name): name.replace(".", "/") for name in folders},
)
