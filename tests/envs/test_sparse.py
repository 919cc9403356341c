"""Models whose constraints MuJoCo stores sparsely."""

from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.envs import models

_C: Any = mujoco
#: Ties of five masses that MuJoCo 4.0.0's Newton's method gets wrong if the constraints are sparse.
TIES = ((0, 2), (0, 3), (1, 2), (1, 3), (2, 4))


def copies_of_five_masses(num_copies: int, options: str = "") -> Any:
    """Returns a model of masses on rails and their ties; from 60 masses on, it is sparse."""
    masses = "".join(
        f"""<body pos="{n} 0 0"><joint name="j{n}" type="slide" axis="0 0 1"/>
          <geom size=".1" mass="{1 + n % 5}"/></body>"""
        for n in range(5 * num_copies)
    )
    ties = "".join(
        f'<joint joint1="j{5 * copy + a}" joint2="j{5 * copy + b}" polycoef="{0.1 * (n + 1)} 1"/>'
        for copy in range(num_copies)
        for n, (a, b) in enumerate(TIES)
    )
    return _C.MjModel.from_xml_string(f"""<mujoco><option {options}/>
      <worldbody>{masses}</worldbody><equality>{ties}</equality>
      <actuator><motor joint="j0"/></actuator></mujoco>""")


def accelerations(model: Any) -> np.ndarray:
    """Returns the accelerations (m/s2) of the masses in the model's pose."""
    data = _C.MjData(model)
    _C.mj_forward(model, data)
    return data.qacc.reshape(-1, len(TIES))


def test_copies_of_masses_move_as_the_masses_do_alone():
    sparse_model = copies_of_five_masses(12)
    assert _C.mj_isSparse(sparse_model)
    loaded = models.load_model(sparse_model)
    alone = accelerations(copies_of_five_masses(1))
    np.testing.assert_allclose(accelerations(loaded), np.tile(alone, (12, 1)), atol=1e-6)
    assert _C.mj_isSparse(sparse_model), "the user's own model has changed"


def test_other_solvers_keep_sparse_constraints():
    for solver in ("CG", "PGS"):
        loaded = models.load_model(copies_of_five_masses(12, f'solver="{solver}"'))
        assert _C.mj_isSparse(loaded)
