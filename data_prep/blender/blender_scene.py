"""Runs inside Blender's Python, started by ``environment``: soft-body motion of an object, and its pictures.

Reads one job (JSON) from standard input, writes the files that the job names and tells each step on standard output.
May import nothing but bpy, mathutils, numpy and the standard library: gausim is not there. What a job holds is said by
``data_prep.blender.plan``, which makes them.
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    # Before bpy is loaded. What Blender prints must not mix with what is told.
    TOLD = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    # Blender moves a soft body while other threads still work out the forces on it, so that some are lost at random.
    # It makes as many threads as there are cores for it when it is loaded: on one core the same motion comes out again.
    os.sched_setaffinity(0, {int(sys.argv[1])})

import bpy
import numpy as np
from mathutils import Matrix, Vector

# The strength of Blender's wind that the search for an amplitude begins with.
FIRST_STRENGTH = 3500.0
TRIALS = 8
TOLERANCE = 0.07
# One trial changes the strength by no more than this, lest a stiff start overshoots.
LARGEST_CHANGE = 4.0
# How far the rendered surface may be from the true points [scene units]; they come from the same lattice.
AGREEMENT = 1e-4
SKY = 0.42
# Rotation (XYZ, radian) and power of the two suns.
SUNS = (((0.5, 0.35, 0.0), 1.1), ((-0.9, -0.5, 0.0), 0.4))


def tell(step: str) -> None:
    """Tells the stage that a step is done; ends the process where nobody listens any more."""
    try:
        TOLD.write(step + "\n")
        TOLD.flush()
    except BrokenPipeError:
        os._exit(1)


def replace_whole(path: Path, data: bytes) -> None:
    """Writes a file so that it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp")
    temporary.write_bytes(data)
    os.replace(temporary, path)


def empty_scene() -> Any:
    """A new scene of Blender's defaults, computed by one thread."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    return scene


def add_object(scene: Any, name: str, data: Any) -> Any:
    """A new object of the scene that shows ``data``."""
    thing = bpy.data.objects.new(name, data)
    scene.collection.objects.link(thing)
    return thing


def add_mesh(scene: Any, vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """A smooth mesh of vertices (V, 3) and triangles (T, 3); without triangles a cloud of points."""
    mesh = bpy.data.meshes.new("surface")
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    mesh.shade_smooth()
    return add_object(scene, "surface", mesh)


# ---------------------------------------------------------------------------------------------------------- simulation


class Cage:
    """The lattice around the object that moves as a soft body and takes the surface along by B-splines."""

    def __init__(self, scene: Any, spec: dict[str, Any]) -> None:
        lattice = bpy.data.lattices.new("cage")
        lattice.points_u, lattice.points_v, lattice.points_w = spec["points"]
        lattice.interpolation_type_u = lattice.interpolation_type_v = lattice.interpolation_type_w = "KEY_BSPLINE"
        self.thing = add_object(scene, "cage", lattice)
        # Control points are one unit apart in the lattice's own frame.
        self.thing.location, self.thing.scale = spec["center"], spec["spacing"]
        self.center, self.spacing = np.array(spec["center"]), np.array(spec["spacing"])
        self._rest = _deformed(lattice)
        self.rest = self._rest * self.spacing + self.center

    def carry(self, surface: Any) -> None:
        """Lets a mesh follow the lattice."""
        surface.modifiers.new("follow", "LATTICE").object = self.thing

    def simulated(self, graph: Any) -> np.ndarray:
        """Control points (L, 3) as the soft body moved them [scene units]."""
        return _deformed(self.thing.evaluated_get(graph).data) * self.spacing + self.center

    def place(self, points: np.ndarray) -> None:
        """Moves the control points to (L, 3) [scene units]; exactly the rest state where they rest."""
        local = self._rest + (points - self.rest) / self.spacing
        for point, position in zip(self.thing.data.points, local.tolist(), strict=True):
            point.co_deform = position
        self.thing.data.update_tag()


def _deformed(lattice: Any) -> np.ndarray:
    values = np.empty(3 * len(lattice.points), np.float32)
    lattice.points.foreach_get("co_deform", values)
    return values.reshape(-1, 3).astype(np.float64)


def soften(cage: Cage, spec: dict[str, Any], soft: dict[str, Any], end: int) -> None:
    """Makes the lattice a soft body whose lowest layers are held at their place."""
    across = spec["points"][0] * spec["points"][1]
    group = cage.thing.vertex_groups.new(name="held")
    for i in range(len(cage.rest)):
        group.add([i], float(i // across < spec["pinned_layers"]), "REPLACE")
    modifier = cage.thing.modifiers.new("soft", "SOFT_BODY")
    settings = modifier.settings
    settings.use_goal, settings.vertex_group_goal = True, "held"
    settings.goal_min, settings.goal_max, settings.goal_default = 0.0, 1.0, 1.0
    settings.goal_spring, settings.goal_friction = 0.999, 0.0
    settings.use_edges, settings.use_stiff_quads = True, True
    settings.pull = settings.push = soft["stiffness"]
    settings.bend, settings.shear, settings.mass, settings.friction = soft["bend"], 1.0, 1.0, 0.0
    settings.damping, settings.speed = soft["damping"], soft["speed"]
    settings.step_min, settings.step_max, settings.error_threshold = soft["steps"], max(300, soft["steps"]), 0.01
    settings.effector_weights.gravity = 0.0
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 0, end


def blow(scene: Any, push: dict[str, Any], falloff: float, strength: float, ticks: int) -> None:
    """A wind from a point that blows at full strength for the first ticks, and then no more."""
    bpy.ops.object.effector_add(type="WIND")
    wind = bpy.context.object
    wind.location, wind.rotation_mode = push["point"], "QUATERNION"
    # A soft body is driven against the field's own z axis.
    wind.rotation_quaternion = Vector((0.0, 0.0, -1.0)).rotation_difference(Vector(push["direction"]))
    field = wind.field
    field.seed, field.flow, field.noise, field.falloff_power = 1, 0.0, 0.0, falloff
    for tick, value in ((0, strength), (ticks, 0.0)):
        field.strength = value
        field.keyframe_insert("strength", frame=tick)
    for curve in wind.animation_data.action.fcurves:
        for key in curve.keyframe_points:
            key.interpolation = "CONSTANT"


def simulate(job: dict[str, Any], points: np.ndarray, strength: float, frames: int) -> dict[str, np.ndarray]:
    """One motion of the points (P, 3): ``displacement`` (F, P, 3) and ``cage`` (F, L, 3), frame 0 the rest state."""
    motion, substeps = job["motion"], job["motion"]["substeps"]
    end = (frames - 1) * substeps
    scene = empty_scene()
    scene.frame_set(0)
    for push in motion["pushes"]:
        blow(scene, push, motion["falloff"], strength, motion["push_ticks"])
    cage = Cage(scene, job["cage"])
    soften(cage, job["cage"], motion["soft"], end)
    probe = add_mesh(scene, points, np.zeros((0, 3), int))
    cage.carry(probe)
    scene.frame_start, scene.frame_end = 0, end
    moved, lattice = [], []
    for tick in range(end + 1):
        scene.frame_set(tick)
        if tick % substeps == 0:
            graph = bpy.context.evaluated_depsgraph_get()
            moved.append(surface_of(probe, graph))
            lattice.append(cage.simulated(graph))
            tell("tick")
    displacement, positions = np.array(moved) - points, np.array(lattice)
    if not (np.isfinite(displacement).all() and np.isfinite(positions).all()):
        raise SystemExit("the soft body left the finite numbers. Use less --stiffness or a smaller --amplitude.")
    if np.abs(displacement[0]).max() > AGREEMENT or np.abs(positions[0] - cage.rest).max() > AGREEMENT:
        raise SystemExit("frame 0 is not the rest state. Is this Blender 4.5?")
    displacement[0], positions[0] = 0.0, cage.rest  # what is left is rounding
    return {"displacement": displacement, "cage": positions, "cage_rest": cage.rest}


def surface_of(thing: Any, graph: Any) -> np.ndarray:
    """Vertices (V, 3) of an object with its modifiers applied."""
    mesh = thing.evaluated_get(graph).data
    values = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", values)
    return values.reshape(-1, 3)


def make_motion(job: dict[str, Any], points: np.ndarray) -> None:
    """Finds the strength that gives the amplitude asked for, and writes the motion it makes."""
    motion = job["motion"]
    target, strength = motion["amplitude"], FIRST_STRENGTH
    trials: list[tuple[float, float, np.ndarray]] = []
    for _ in range(TRIALS):
        found = simulate(job, points, strength, min(motion["trial_frames"], motion["frames"]))
        ratio = target / max(float(np.linalg.norm(found["displacement"], axis=-1).max()), 1e-9)
        trials.append((abs(math.log(ratio)), strength, found["displacement"]))
        if trials[-1][0] <= math.log1p(TOLERANCE):
            break
        strength *= min(max(ratio, 1 / LARGEST_CHANGE), LARGEST_CHANGE)
    off, strength, expected = min(trials, key=lambda trial: trial[0])
    if off > math.log(2.0):
        raise SystemExit(
            f"no push gives an amplitude of {target:.3f} scene units: the nearest is off by a factor of "
            f"{math.exp(off):.1f}. Use another --amplitude, --stiffness or --seed."
        )
    made = simulate(job, points, strength, motion["frames"])
    if not np.array_equal(made["displacement"][: len(expected)], expected):
        raise SystemExit("the same push did not move the object the same way twice. Is this process on one core?")
    held = io.BytesIO()
    stored: dict[str, Any] = {name: array.astype(np.float32) for name, array in made.items()}
    np.savez_compressed(held, strength=np.float64(strength), **stored)
    replace_whole(Path(motion["file"]), held.getvalue())


# ----------------------------------------------------------------------------------------------------------- pictures


def dress(thing: Any, colours: np.ndarray) -> None:
    """A matt skin of linear RGB (V, 3) given at the vertices."""
    attribute = thing.data.color_attributes.new("albedo", "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", np.pad(colours, ((0, 0), (0, 1)), constant_values=1.0).ravel())
    skin = bpy.data.materials.new("skin")
    skin.use_nodes = True
    nodes, links = skin.node_tree.nodes, skin.node_tree.links
    nodes.clear()
    end = nodes.new("ShaderNodeOutputMaterial")
    matt = nodes.new("ShaderNodeBsdfDiffuse")
    colour = nodes.new("ShaderNodeVertexColor")
    colour.layer_name = "albedo"
    links.new(colour.outputs["Color"], matt.inputs["Color"])
    links.new(matt.outputs["BSDF"], end.inputs["Surface"])
    thing.data.materials.append(skin)


def light(scene: Any) -> None:
    """An even white sky and two wide suns."""
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs[0].default_value, background.inputs[1].default_value = (1.0, 1.0, 1.0, 1.0), SKY
    for rotation, power in SUNS:
        sun = bpy.data.lights.new("sun", "SUN")
        sun.energy, sun.angle = power, 0.5
        add_object(scene, "sun", sun).rotation_euler = rotation


def set_up_camera(scene: Any, camera: dict[str, Any]) -> None:
    """A pinhole camera of the job's size and angle."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle = "HORIZONTAL", camera["angle_x"]
    scene.camera = add_object(scene, "camera", lens)
    scene.render.resolution_x, scene.render.resolution_y = camera["size"]
    scene.render.resolution_percentage = 100


def set_up_cycles(scene: Any, samples: int) -> None:
    """Cycles on the processor, without anything that depends on time, place or earlier pictures."""
    import addon_utils

    addon_utils.enable("cycles")
    render, cycles = scene.render, scene.cycles
    render.engine, render.film_transparent, render.use_persistent_data = "CYCLES", True, False
    render.dither_intensity = 0.0
    form = render.image_settings
    form.file_format, form.color_mode, form.color_depth, form.compression = "PNG", "RGBA", "8", 90
    for stamp in ("date", "time", "render_time", "frame", "scene", "camera", "filename", "memory", "hostname"):
        setattr(render, f"use_stamp_{stamp}", False)
    scene.view_settings.view_transform = "Standard"
    cycles.device, cycles.samples, cycles.seed = "CPU", samples, 0
    cycles.use_denoising, cycles.use_adaptive_sampling = False, False
    cycles.max_bounces, cycles.diffuse_bounces = 3, 2


def take(scene: Any, image: dict[str, Any]) -> None:
    """Renders one picture into its file."""
    path = Path(image["file"])
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.png")
    scene.camera.matrix_world = Matrix(image["pose"])
    scene.render.filepath = str(temporary)
    bpy.ops.render.render(write_still=True)
    os.replace(temporary, path)
    tell("image")


def make_pictures(job: dict[str, Any], rest: dict[str, np.ndarray]) -> None:
    """Renders the pictures of the job: of the rest state, or of the frames of its motion."""
    scene = empty_scene()
    surface = add_mesh(scene, rest["vertices"], rest["faces"])
    dress(surface, rest["albedo_linear"].astype(np.float32))
    light(scene)
    set_up_camera(scene, job["camera"])
    set_up_cycles(scene, job["samples"])
    if job["motion"] is None:
        for image in job["images"]:
            take(scene, image)
        return
    with np.load(job["motion"]["file"], allow_pickle=False) as file:
        motion = {name: file[name] for name in ("cage", "cage_rest", "displacement")}
    cage = Cage(scene, job["cage"])
    cage.carry(surface)
    offset = cage.rest - motion["cage_rest"]  # rounding of what is stored: frame 0 is to be the rest state exactly
    for frame in sorted({image["frame"] for image in job["images"]}):
        cage.place(motion["cage"][frame] + offset)
        shown = surface_of(surface, bpy.context.evaluated_depsgraph_get())[rest["gt_ids"]]
        true = rest["vertices"][rest["gt_ids"]] + motion["displacement"][frame]
        if np.abs(shown - true).max() > AGREEMENT:
            raise SystemExit(f"frame {frame}: the surface is not where the true points are. Is this Blender 4.5?")
        for image in job["images"]:
            if image["frame"] == frame:
                take(scene, image)


def main() -> None:
    """Does one job."""
    job = json.load(sys.stdin)
    if job["task"] == "versions":
        print(
            json.dumps({"bpy": bpy.app.version_string, "numpy": np.__version__, "python": sys.version.split()[0]}),
            file=TOLD,
        )
        return
    with np.load(job["rest"], allow_pickle=False) as file:
        rest = {name: file[name] for name in file.files}
    if job["motion"] is not None and not Path(job["motion"]["file"]).is_file():
        make_motion(job, rest["vertices"][rest["gt_ids"]])
    if job["images"]:
        make_pictures(job, rest)


if __name__ == "__main__":
    main()
