"""One row per robot: how it is drawn, and in which units and terms its movement is described.

A new robot needs a row here and one in `tasks.bodies`; a robot without a row is drawn as a body of limbs, from
where these spread most.
"""

from __future__ import annotations

from dataclasses import dataclass

from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_name


@dataclass(frozen=True)
class View:
    """How a robot is drawn.

    Attributes:
        axes: Which of x, y, z point right and up in a stick figure.
        ground: Whether the ground is the line z = 0.
        limbs: Whether there is more to draw than a point.
        held: Seconds that a skill is held to see what it does, rounded to whole skills.
        bodies: Number of bodies between the first and the last of a stroboscopic picture.
        camera: MuJoCo's camera: distance in metres, azimuth and elevation in degrees.
        looks_at: Where the camera looks; None follows the body at the height `eye`.
        eye: Height of the camera's target in metres.
        path: Names of the coordinates of a replayed path, see `measure.body.root_path`.
        hand: Whether the path is that of the robot's hand, in three dimensions.
        units: Units of displacement and of speed.
        mover: What moves, for use in a sentence.
        turn: Heading of the column of turns.
        turns: What that column means, for use in a sentence.
    """

    axes: tuple[int, int] = (0, 2)
    ground: bool = False
    limbs: bool = True
    held: float = 2.0
    bodies: int = 6
    camera: tuple[float, float, float] = (2.5, 90.0, -6.0)
    looks_at: tuple[float, float, float] | None = None
    eye: float = 0.8
    path: tuple[str, ...] = ("along x", "along y")
    hand: bool = False
    units: tuple[str, str] = ("m", "m/s")
    mover: str = "the body"
    turn: str = "turn"
    turns: str = "it turns between the directions of the two halves, left is positive"

    @property
    def labels(self) -> tuple[str, str]:
        """Labels of the two axes of a stick figure."""
        right, up = ("xyz"[axis] for axis in self.axes)
        return f"{right} (m)", f"{up} (m)"


RUNNER = View(
    ground=True,
    held=1.0,
    bodies=8,
    path=("along x", "along z"),
    turn="pitch change",
    turns="its pitch changes",
)
VIEWS = {
    "halfcheetah": RUNNER,
    "hopper": RUNNER,
    "walker2d": RUNNER,
    "antmaze": View(
        axes=(0, 1), held=6.0, bodies=4, camera=(4.5, 90.0, -88.0), path=("ahead of the ant", "to its left")
    ),
    "pointmaze": View(axes=(0, 1), limbs=False, held=1.0),
    "kitchen": View(
        held=2.4,
        camera=(2.4, 70.0, -30.0),
        looks_at=(-0.2, 0.5, 2.0),
        path=("along x", "along y", "along z"),
        hand=True,
        units=("rad", "rad/s"),
        mover="its arm's joints",
    ),
}
"""Name of a robot -> how it is drawn."""


def has_view(task: Task) -> bool:
    """Whether somebody has said how a task's robot is drawn."""
    return body_name(task) in VIEWS


def view_of(task: Task) -> View:
    """Return how a task's robot is drawn."""
    return VIEWS.get(body_name(task), View())
