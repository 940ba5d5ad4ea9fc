"""`python -m beers_deploy` is the command line, for environments whose scripts are not on the PATH."""

from beers_deploy.cli import app

app(prog_name="beers-deploy")
