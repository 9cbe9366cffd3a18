"""The workflow lies beside the command in a wheel; an editable installation uses it where it stands."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Shipped(BuildHookInterface):  # type: ignore[type-arg]
    """Maps what pyproject.toml lists into the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files, but not to an editable wheel, whose copies would grow old."""
        if version == "standard":
            build_data["force_include"].update(self.config["files"])
