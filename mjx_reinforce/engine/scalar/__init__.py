"""A drop-in for ``jax.vmap`` that leaves only elementwise arithmetic, loops and branches.

A function such as ``mjx.step`` on a small model is thousands of operations on vectors of three and
matrices of two by two, most of them slices and reshapes. Under ``jax.vmap`` each becomes a pass
over memory. Here the function is traced for one example, written out in scalars, its constants
folded in NumPy, and evaluated with one array over the batch (a *lane*) for each scalar. What is
left is elementwise arithmetic that XLA fuses, and loops and branches that stay loops and branches.

What to know before using it:

- The arithmetic is that of the function, in its order, with the exceptions listed below. A NaN in
  one lane never reaches another.
- A ``while`` ends when no lane goes on, and a lane that is done keeps its values. An expensive
  branch of ``cond`` runs only if some lane needs it. Under an outer ``jax.vmap`` both stay as they
  are: see ``any_lane``.
- Everything is written out, so it is for small states: tens to hundreds of scalars. A matrix
  product of n × m × k becomes 2nmk operations. What is larger than ``size.MAX_SCALARS`` raises
  ``TooLarge``; XLA takes minutes to compile what is larger than ``vmap.MAX_OPERATIONS``, and that
  is warned of.
- Differentiation works where JAX's does: not in reverse through a ``while``. Rules of
  ``jax.custom_jvp`` and ``jax.custom_vjp`` are not kept; the function itself is differentiated.
- ``lax.platform_dependent`` takes its default: what is written out does not depend on where it
  runs. ``is_written_out`` tells a function whether it is traced for that or for XLA, and of what is
  ``skippable`` no lane's own result is selected.
- A primitive without a rule raises ``UnsupportedPrimitive``, which names the line it came from.
  Typed PRNG keys and ``lax.platform_dependent`` without a default raise it too.

All exceptions of floating-point arithmetic, where 0 and the exponent are constants:

- x * 0, 0 / x and x - x are 0, also where x is infinite or NaN.
- x times a bool is 0 where the bool is false, also where x is infinite or NaN.
- The sign of a zero is not kept: x + 0 is x, 0 - x is -x, and -(x - y) is y - x.
- A power with a constant integer exponent up to 8 is a product, which rounds otherwise.
- Sums and matrix products are added up in index order, so they round otherwise.
- The Cholesky factor of a matrix that is not positive definite is NaN from the column on where that
  shows, and not everywhere.

So ``(x - x) == 0`` is true for every x; ``jnp.isfinite`` is what tells whether x is finite.
"""

from mjx_reinforce.engine.scalar.jaxprs import UnsupportedPrimitive as UnsupportedPrimitive
from mjx_reinforce.engine.scalar.jaxprs import prune as prune
from mjx_reinforce.engine.scalar.primitives import any_lane as any_lane
from mjx_reinforce.engine.scalar.primitives import is_written_out as is_written_out
from mjx_reinforce.engine.scalar.primitives import short_scan as short_scan
from mjx_reinforce.engine.scalar.primitives import simulated_models as simulated_models
from mjx_reinforce.engine.scalar.primitives import skippable as skippable
from mjx_reinforce.engine.scalar.primitives import whole as whole
from mjx_reinforce.engine.scalar.primitives import writing_out as writing_out
from mjx_reinforce.engine.scalar.scalarized import Scalarized as Scalarized
from mjx_reinforce.engine.scalar.scalarized import scalarize as scalarize
from mjx_reinforce.engine.scalar.size import TooLarge as TooLarge
from mjx_reinforce.engine.scalar.vmap import vmap as vmap
