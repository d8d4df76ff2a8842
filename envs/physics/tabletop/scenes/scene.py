"""The eighty scenes: which object, which container beside it, on which table."""

from __future__ import annotations

from dataclasses import dataclass

from envs.physics.tabletop.scenes.catalogue import CONTAINERS, TABLES, THINGS


@dataclass(frozen=True)
class Scene:
    """An object, the kind of container beside it, and the table."""

    thing: str
    container: str
    table: str

    @property
    def name(self) -> str:
        """Such as red_cube-bowl-oak."""
        return f"{self.thing}-{self.container}-{self.table}"


SCENES = {
    scene.name: scene
    for scene in (
        Scene(thing, container, table) for thing in THINGS for container in CONTAINERS for table in TABLES
    )
}
