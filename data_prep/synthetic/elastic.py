"""Motion of an elastic body: linear tetrahedra in MuJoCo's flex, set off by a velocity, by gravity or by hands."""

from __future__ import annotations

import mujoco
import numpy as np

from data_prep.synthetic.bodies import Array, Body
from data_prep.synthetic.plan import Floor, Material
from gausim.core import DivergenceError


class ElasticBody:
    """A compiled MuJoCo model of one body of one material."""

    def __init__(
        self, body: Body, material: Material, *, fps: float, time_step: float = 1e-3, viscosity: float | None = None,
        floor: Floor | None = None, driven: bool = False,
    ) -> None:  # fmt: skip
        """Compiles the model.

        Args:
            body: its rest shape.
            material: of the body.
            fps: frames per second of the result.
            time_step: longest step of the integrator [s]; stable up to about 1e-3 at the stiffnesses used here.
            viscosity: damping forces of the elements over their stiffness [s]; none when None.
            floor: floor under the body, and gravity towards it.
            driven: whether the held nodes follow a path; otherwise they never move.
        """
        self._model = mujoco.MjModel.from_xml_string(_model_xml(body, material, viscosity, floor, driven=driven))
        self.substeps = int(np.ceil(1 / (fps * time_step)))
        self._model.opt.timestep = 1 / fps / self.substeps
        parts = self._model.flex_vertbodyid
        self._held, self._free = np.flatnonzero(body.held), np.flatnonzero(self._model.body_dofnum[parts] == 3)
        self._dofs = self._model.body_dofadr[parts][:, None] + np.arange(3)  # (N, 3) degrees of freedom
        # The integrator treats this damping implicitly, so it is stable at any rate.
        self._model.dof_damping[:] = material.drag * material.mass / len(body.nodes)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self.rest = self._data.flexvert_xpos.copy()
        if np.abs(self.rest - body.nodes).max() > 1e-4:
            raise DivergenceError("MuJoCo changed the order or the place of the nodes; use mujoco>=3.3,<5.")

    def set_uneven(self, young_modulus: Array, masses: Array, drag: Array) -> None:
        """Makes the material uneven.

        Args:
            young_modulus: of each tetrahedron, in the material's (T,).
            masses: of the nodes (N,).
            drag: of the nodes (N,), force over momentum [1/s].
        """
        model, free = self._model, self._free
        model.flex_stiffness.reshape(len(young_modulus), -1)[:] *= young_modulus[:, None]
        model.body_mass[model.flex_vertbodyid[free]] = masses[free]
        model.dof_damping[self._dofs[free]] = (drag * masses)[free, None]
        mujoco.mj_setConst(model, self._data)

    def simulate(self, velocity: Array, frames: int, *, shift: Array | None = None, path: Array | None = None) -> Array:
        """Positions (frames, N, 3) after an initial ``velocity`` (N, 3); frame 0 is exactly the rest shape.

        Args:
            velocity: of the nodes [scene units / s].
            frames: frames of the result.
            shift: where a body without held nodes starts, (3,) from its rest state [scene units].
            path: positions of the held nodes of a driven body after every step of the integrator,
                ((frames - 1) ``substeps`` + 1, H, 3) [scene units], beginning at rest.

        Raises:
            DivergenceError: MuJoCo warned (it resets silently on NaN) or a position is not finite.
        """
        model, data, free = self._model, self._data, self._dofs[self._free]
        mujoco.mj_resetData(model, data)
        # Half a kick of gravity back: then the semi-implicit steps fall on the parabola itself.
        data.qvel[free] = velocity[self._free] - 0.5 * model.opt.timestep * model.opt.gravity
        if shift is not None:
            data.qpos[free] = shift
        positions, messages = [self.rest if shift is None else self.rest + shift], list[str]()
        default = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(messages.append)  # by default MuJoCo writes a log file where one stands
        try:
            for frame in range(1, frames):
                self._advance(frame, path)
                if messages:
                    break
                mujoco.mj_kinematics(model, data)
                mujoco.mj_flex(model, data)
                positions.append(data.flexvert_xpos.copy())
        finally:
            mujoco.set_mju_user_warning(default)
        if messages or any(int(w.number) for w in data.warning) or not np.isfinite(positions).all():
            raise DivergenceError(
                f"MuJoCo's body left the finite numbers within {frames} frames at a step of {model.opt.timestep:.2g} s "
                f"({'; '.join(messages) or 'no message'}). Soften the material or shorten the step."
            )
        return np.array(positions)

    def _advance(self, frame: int, path: Array | None) -> None:
        """Steps to a frame; held nodes are put on their path before every step and at the end."""
        model, data = self._model, self._data
        if path is None:
            mujoco.mj_step(model, data, nstep=self.substeps)
            return
        held, rest = self._dofs[self._held], self.rest[self._held]
        start, stop = (frame - 1) * self.substeps, frame * self.substeps
        for step in range(start, stop):
            data.qpos[held] = path[step] - rest
            data.qvel[held] = (path[step + 1] - path[step]) / model.opt.timestep
            mujoco.mj_step(model, data)
        data.qpos[held] = path[stop] - rest


def _model_xml(body: Body, material: Material, viscosity: float | None, floor: Floor | None, *, driven: bool) -> str:
    # Without viscosity the elasticity's damping is as good as off (larger ones explode under Euler at long steps);
    # zero would make MuJoCo warn into a log file.
    points = " ".join(f"{x:.9g}" for x in body.nodes.ravel())
    elements = " ".join(map(str, body.tetrahedra.ravel()))
    held = " ".join(map(str, np.flatnonzero(body.held)))
    pin = "" if driven or not held else f'<pin id="{held}"/>'
    gravity, plane, touch = "0 0 0", "", 'contype="0" conaffinity="0"'
    off = '<flag contact="disable" constraint="disable"/>'
    if floor is not None:
        # Contacts are stiff, so that nodes stay above the floor, and hardly damped: the body's elasticity bounces.
        touch = f'contype="1" conaffinity="1" condim="3" friction="{floor.friction} 0 0" solref="0.006 0.2"'
        plane = f'<geom type="plane" size="9 9 1" {touch}/>'
        gravity, off = f"0 0 -{floor.gravity}", ""
    return f"""<mujoco>
 <option integrator="Euler" solver="CG" gravity="{gravity}">{off}</option>
 <worldbody>
  {plane}
  <flexcomp name="body" type="direct" dim="3" mass="{material.mass}" radius="0.001" point="{points}"
            element="{elements}">
   <elasticity young="{material.young_modulus}" poisson="{material.poisson_ratio}" damping="{viscosity or 1e-9}"/>
   <contact selfcollide="none" {touch}/>
   {pin}
  </flexcomp>
 </worldbody></mujoco>"""
