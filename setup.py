"""Install one package: `beers_deploy` is deploy/, with model/, quant/ and profiles/ inside it."""

from os import umask
from shutil import rmtree

from setuptools import find_namespace_packages, setup
from setuptools.command.build_py import build_py

INSIDE = ("model", "quant", "profiles")
folders = find_namespace_packages(
    include=[f"{name}{end}" for name in ("deploy", *INSIDE) for end in ("", ".*")]
)


def installed(name: str) -> str:
    """Return the name of a folder's package where it is installed."""
    return (
        name.replace("deploy", "beers_deploy", 1)
        if name.startswith("deploy")
        else f"beers_deploy.{name}"
    )


class FreshBuild(build_py):
    """A build without what an earlier one left in its folder: all that lies there is packed."""

    def run(self) -> None:
        """Empty the folder, and build."""
        if not self.editable_mode:
            rmtree(self.build_lib, ignore_errors=True)
        super().run()


umask(0o022)  # the modes of the files in a wheel are part of its bytes
setup(
    cmdclass={"build_py": FreshBuild},
    packages=[installed(name) for name in folders],
    package_dir={installed(name): name.replace(".", "/") for name in folders},
)
