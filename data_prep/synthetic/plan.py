"""Plan of the embedded set: objects, their materials, numbers and sizes of sequences and pictures."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from data_prep.common.command import Options, names, option
from gausim.core.errors import ConfigError

TRAIN_FRAMES = 16  # frames 0..15 are seen, as the paper trains
# Amplitudes of a push that stays nearly linear, and of one that bends a body far beyond [diagonals].
SMALL_SWING, LARGE_SWING = (0.05, 0.08), (0.18, 0.28)
LARGEST_SWING = 0.5  # [diagonals]; further the finite elements turn inside out


@dataclass(frozen=True)
class Material:
    """Elastic material of a body."""

    young_modulus: float  # stiffness [mass / (scene unit s^2)]
    poisson_ratio: float  # resistance to change of volume
    drag: float  # mass-proportional damping; amplitudes fall as exp(-drag t / 2) [1/s]
    mass: float = 1.0  # of the whole body


@dataclass(frozen=True)
class Floor:
    """The plane z = 0, on which a body falls along -z."""

    gravity: float  # [scene units / s^2]
    friction: float  # Coulomb's coefficient


@dataclass(frozen=True)
class Recipe:
    """Definition of an object."""

    body: str  # a shape of :data:`data_prep.synthetic.bodies.BODIES`
    material: Material  # of the body
    time_step: float  # that its stiffness allows [s]
    swing: tuple[float, float] = SMALL_SWING  # least and largest amplitude of its pushes [diagonals]
    viscosity: float | None = None  # damping forces over stiffness, in the place of drag [s]
    floor: Floor | None = None  # what it falls on; then it is free, and not pushed
    hands: tuple[str, ...] | None = None  # kinds of paths of the hands that move it; then it is not pushed
    like: str | None = None  # the object that it is, in other motions: its name, looks and kernels
    train: float | None = None  # fraction of the frames that are seen; frames 0..15 unless given
    room: tuple[tuple[float, float, float], float] | None = None  # ball that the video cameras see: centre and radius

    @property
    def facts(self) -> dict[str, object]:
        """The fields that are given, for ``dataset.json``."""
        return {name: value for name, value in asdict(self).items() if value is not None}


# Periods of the slowest mode are about 14 frames (soft) and 9 frames (firm) at 24 frames per second.
SOFT_PUDDING = Recipe("pudding", Material(young_modulus=170.0, poisson_ratio=0.35, drag=0.5), 2e-3)
SOFT_FLOWER = Recipe("flower", Material(young_modulus=8e4, poisson_ratio=0.35, drag=0.5), 2e-4)
TWO_HANDS = Recipe(
    "bar", Material(young_modulus=1500.0, poisson_ratio=0.35, drag=0.0), 2e-4, viscosity=0.004,
    hands=("stretch", "bend", "swing"), train=0.7, room=((0.0, 0.0, 0.8), 1.25),
)  # fmt: skip
RECIPES = {
    "pudding_soft": SOFT_PUDDING,
    "pudding_firm": Recipe("pudding", Material(young_modulus=400.0, poisson_ratio=0.35, drag=0.5), 2e-3),
    "flower_soft": SOFT_FLOWER,
    "flower_firm": Recipe("flower", Material(young_modulus=1.7e5, poisson_ratio=0.35, drag=0.5), 1.5e-4),
    # The soft pudding turns inside out when pushed so far. This one keeps its volume and has the friction of a gel (a
    # tenth of the energy per radian), so that a push of 1 % more does not lead elsewhere.
    "pudding_swing": replace(
        SOFT_PUDDING, material=replace(SOFT_PUDDING.material, poisson_ratio=0.45), time_step=2e-4, viscosity=0.008,
        swing=LARGE_SWING,
    ),
    "flower_swing": replace(SOFT_FLOWER, swing=LARGE_SWING),
    # Fine detail, and swings that one sees: the object of the demo.
    "gerbera": Recipe(
        "potted", Material(young_modulus=3.6e5, poisson_ratio=0.35, drag=0.65), 1e-4, swing=(0.12, 0.2),
        room=((0.07, 0.0, 0.8), 0.86),
    ),
    # Lands at about frame 10 and touches the floor for 4 to 5 frames.
    "jelly_fall": Recipe(
        "jelly", Material(young_modulus=400.0, poisson_ratio=0.35, drag=0.0), 2e-4, viscosity=0.0015,
        floor=Floor(gravity=5.0, friction=0.5), room=((0.0, 0.0, 0.6), 1.15),
    ),
    "bar_hands": TWO_HANDS,
    "bar_hands_new": replace(TWO_HANDS, hands=("crank", "twist"), like="bar_hands"),
}  # fmt: skip


@dataclass(frozen=True)
class Plan(Options):
    """Size of a set; of each object pokes and drags take turns."""

    objects: tuple[str, ...] = option(
        ("pudding_soft", "pudding_firm", "flower_soft", "flower_swing", "pudding_swing"), "make only these objects",
        type=names, metavar="NAME,NAME",
    )  # fmt: skip
    sequences: int = option(8, "make so many sequences per object", least=1)
    frames: int = option(50, "make so many frames per sequence, at least 16", least=TRAIN_FRAMES)
    fps: int = 24
    train_views: int = 4  # a held-out one is added
    stills: int = 24
    resolution: tuple[int, ...] = option(
        (96,), "draw the videos in this width and height, or so large a square [pixels]", least=1, nargs="+",
        metavar=("WIDTH", "HEIGHT"),
    )  # fmt: skip
    still_resolution: int = 192
    kernels: int = option(800, "give an object so many Gaussians, at least 50", least=50)
    swing: tuple[float, float] | None = option(
        None, "push by amplitudes from LOW to HIGH [fractions of the diagonal]; each object's own unless given",
        least=1e-9, most=LARGEST_SWING, interval=True,
    )  # fmt: skip
    seed: int = option(0, "draw everything random with this seed (0)")

    def __post_init__(self) -> None:
        """Checks the numbers and the names."""
        super().__post_init__()
        unknown = [name for name in self.objects if name not in RECIPES]
        if unknown or not self.objects:
            raise ConfigError(f"objects: no recipe for {unknown}; choose some of {', '.join(RECIPES)}.")
        if len(self.resolution) not in (1, 2):
            raise ConfigError(f"--resolution: expected WIDTH HEIGHT or one number, got {len(self.resolution)} numbers.")

    @property
    def views(self) -> tuple[str, ...]:
        """Names of all cameras, the held-out one last."""
        return tuple(f"cam_{i}" for i in range(self.train_views + 1))


QUICK = replace(
    Plan(), objects=("pudding_soft", "flower_soft"), sequences=2, frames=20, stills=10, resolution=(48,),
    still_resolution=64, kernels=150,
)  # fmt: skip
