"""Motion of an elastic body: linear tetrahedra in MuJoCo's flex, set off by an initial velocity."""

from __future__ import annotations

import mujoco
import numpy as np

from data_prep.synthetic.bodies import Array, Body
from data_prep.synthetic.plan import Material
from gausim.core import DivergenceError


class ElasticBody:
    """A compiled MuJoCo model of one body of one material."""

    def __init__(self, body: Body, material: Material, *, fps: float, time_step: float = 1e-3) -> None:
        """Compiles the model.

        Args:
            body: its rest shape.
            material: of the body.
            fps: frames per second of the result.
            time_step: longest step of the integrator [s]; stable up to about 1e-3 at the stiffnesses used here.
        """
        self._model = mujoco.MjModel.from_xml_string(_model_xml(body, material))
        self._substeps = int(np.ceil(1 / (fps * time_step)))
        self._model.opt.timestep = 1 / fps / self._substeps
        # The integrator treats this damping implicitly, so it is stable at any rate.
        self._model.dof_damping[:] = material.drag * material.mass / len(body.nodes)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._rest = self._data.flexvert_xpos.copy()
        if np.abs(self._rest - body.nodes).max() > 1e-4:
            raise DivergenceError("MuJoCo changed the order or the place of the nodes; use mujoco>=3.3,<5.")

    def set_uneven(self, young_modulus: Array, masses: Array, drag: Array) -> None:
        """Makes the material uneven.

        Args:
            young_modulus: of each tetrahedron, in the material's (T,).
            masses: of the nodes (N,).
            drag: of the nodes (N,), force over momentum [1/s].
        """
        model = self._model
        model.flex_stiffness.reshape(len(young_modulus), -1)[:] *= young_modulus[:, None]
        for node, part in enumerate(model.flex_vertbodyid):
            if model.body_dofnum[part] == 3:
                first = model.body_dofadr[part]
                model.body_mass[part] = masses[node]
                model.dof_damping[first : first + 3] = drag[node] * masses[node]
        mujoco.mj_setConst(model, self._data)

    def simulate(self, velocity: Array, frames: int) -> Array:
        """Positions (frames, N, 3) after an initial ``velocity`` (N, 3); frame 0 is exactly the rest state.

        Raises:
            DivergenceError: MuJoCo warned (it resets silently on NaN) or a position is not finite.
        """
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        for node, part in enumerate(model.flex_vertbodyid):
            if model.body_dofnum[part] == 3:
                first = model.body_dofadr[part]
                data.qvel[first : first + 3] = velocity[node]
        positions, messages = [self._rest], list[str]()
        default = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(messages.append)  # by default MuJoCo writes a log file where one stands
        try:
            for _ in range(1, frames):
                mujoco.mj_step(model, data, nstep=self._substeps)
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


def _model_xml(body: Body, material: Material) -> str:
    # The elasticity's damping is as good as off (it explodes under Euler); zero would make MuJoCo warn into a log file.
    points = " ".join(f"{x:.9g}" for x in body.nodes.ravel())
    elements = " ".join(map(str, body.tetrahedra.ravel()))
    held = " ".join(map(str, np.flatnonzero(body.held)))
    return f"""<mujoco>
 <option integrator="Euler" solver="CG" gravity="0 0 0"><flag contact="disable" constraint="disable"/></option>
 <worldbody>
  <flexcomp name="body" type="direct" dim="3" mass="{material.mass}" radius="0.001" point="{points}"
            element="{elements}">
   <elasticity young="{material.young_modulus}" poisson="{material.poisson_ratio}" damping="1e-9"/>
   <contact selfcollide="none" contype="0" conaffinity="0"/>
   <pin id="{held}"/>
  </flexcomp>
 </worldbody></mujoco>"""
