"""Which version is this, and what is it called where it is installed from?"""

from __future__ import annotations

from pathlib import Path

DISTRIBUTION = "quasipotential"  # what pip installs; the name `siq` is another project's there


def version() -> str:
    """The version in pyproject.toml: of the checkout that this file lies in, else of the installation."""
    checkout = Path(__file__).parents[1] / "pyproject.toml"
    if checkout.is_file():
        import tomllib  # here, so that `siq --help` answers at once

        project = tomllib.loads(checkout.read_text(encoding="utf-8")).get("project", {})
        if project.get("name") == DISTRIBUTION:
            return str(project["version"])
    from importlib.metadata import version as installed

    return installed(DISTRIBUTION)
