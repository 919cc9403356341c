"""An update of each engine is that of its golden file: the mathematics changes on purpose alone."""

import golden
import numpy as np
import pytest

from mjx_reinforce.engine.play import available

#: Of the greatest value of an array. The engines differ by 1e-6, for each rounds in its own order,
#: as versions of JAX and XLA's flags do; a discount of 0.985 in place of 0.99 changes 5e-2.
_ROUNDING = 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("engine", golden.ENGINES)
def test_an_update_is_as_it_was(engine):
    if engine == "native" and (reason := available.unavailable()):
        pytest.skip(reason)
    got = golden.updated(engine)
    with np.load(golden.FOLDER / f"{engine}.npz", allow_pickle=False) as want:
        assert sorted(got) == sorted(want.files)
        for name in want.files:
            atol = _ROUNDING * max(np.abs(want[name]).max(), 1e-6)
            np.testing.assert_allclose(got[name], want[name], rtol=0, atol=atol, err_msg=name)


def test_the_engines_make_the_same_update():
    """The files too: one that a broken engine wrote would differ from the other."""
    native, vmap = (np.load(golden.FOLDER / f"{engine}.npz") for engine in ("native", "vmap"))
    assert np.abs(vmap["params"]).max() > 1e-3
    for name in vmap.files:
        atol = _ROUNDING * max(np.abs(vmap[name]).max(), 1e-6)
        np.testing.assert_allclose(native[name], vmap[name], rtol=0, atol=atol, err_msg=name)
