"""The transcendental operations of the scalar graph in LLVM IR.

Those of float32 lanes are ours, but for rare ones; those of float64 lanes, which CPUs alone have,
are the C library's: right before fast.
"""

from collections.abc import Callable

from mjx_reinforce.engine.llvm import exponential, trigonometry
from mjx_reinforce.engine.llvm.lanes import INFINITY, Lanes

#: What no task and no policy of ours computes with: the C library does, in double precision.
RARE = ("acosh", "asinh", "atanh", "cbrt", "cosh", "erfc", "exp2", "sinh")
#: The names of the scalar graph that the C library has as functions of doubles.
_LIBRARY = (
    *("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "cos", "cosh", "erf"),
    *("erfc", "exp", "exp2", "expm1", "log", "log1p", "pow", "sin", "sinh", "tan", "tanh"),
)


def _library(name: str) -> Callable[..., Lanes]:
    """Returns what calls a function of the C library for each lane."""

    def write(*operands: Lanes) -> Lanes:
        text, kind = operands[0].text, operands[0].text.type(operands[0].dtype)
        kinds = ", ".join(["double"] * len(operands))
        text.declared.add(f"declare double @{name}({kinds})")
        if text.lanes == 1:
            arguments = ", ".join(f"double {x.name}" for x in operands)
            return operands[0].named(text.let(f"call double @{name}({arguments})"))
        result = "poison"
        for lane in range(text.lanes):
            at = f"i64 {lane}"
            scalars = [text.let(f"extractelement {kind} {x.name}, {at}") for x in operands]
            arguments = ", ".join(f"double {x}" for x in scalars)
            value = text.let(f"call double @{name}({arguments})")
            result = text.let(f"insertelement {kind} {result}, double {value}, {at}")
        return operands[0].named(result)

    return write


def _rounded(name: str) -> Callable[..., Lanes]:
    """Returns what calls a function of the C library for each lane of float32."""
    call = _library(name)
    return lambda x: call(x.convert("fpext", "float64")).convert("fptrunc", "float32")


def _logistic(x: Lanes) -> Lanes:
    """Returns 1 / (1 + exp(-x))."""
    return 1 / (_library("exp")(-x) + 1)


def _erf_inv(x: Lanes) -> Lanes:
    """Returns the inverse of the error function.

    Coefficients: M. Giles, Approximating the erfinv function (2012), as in XLA.
    """
    w = -_library("log1p")(x * -x)
    root = w.call("sqrt")
    central = (w - 3.125).polynomial(
        *(-3.64441206401782e-21, -1.6850591381820166e-19, 1.28584807152564e-18),
        *(1.1157877678025181e-17, -1.3331716628546209e-16, 2.0972767875968562e-17),
        *(6.6376381343583238e-15, -4.0545662729752069e-14, -8.1519341976054722e-14),
        *(2.6335093153082323e-12, -1.2975133253453532e-11, -5.4154120542946279e-11),
        *(1.0512122733215323e-09, -4.1126339803469837e-09, -2.9070369957882005e-08),
        *(4.2347877827932404e-07, -1.3654692000834679e-06, -1.3882523362786469e-05),
        *(0.00018673420803405714, -0.000740702534166267, -0.0060336708714301491),
        *(0.24015818242558962, 1.6536545626831027),
    )
    middle = (root - 3.25).polynomial(
        *(2.2137376921775787e-09, 9.0756561938885391e-08, -2.7517406297064545e-07),
        *(1.8239629214389228e-08, 1.5027403968909828e-06, -4.013867526981546e-06),
        *(2.9234449089955446e-06, 1.2475304481671779e-05, -4.7318229009055734e-05),
        *(6.8284851459573175e-05, 2.4031110387097894e-05, -0.00035503752036284748),
        *(0.0009532893797373805, -0.0016882755560235047, 0.0024914420961078508),
        *(-0.0037512085075692412, 0.0053709145535900636, 1.0052589676941592),
        *(3.0838856104922208,),
    )
    tail = (root - 5).polynomial(
        *(-2.7109920616438573e-11, -2.5556418169965252e-10, 1.5076572693500548e-09),
        *(-3.789465440126737e-09, 7.61570120807834e-09, -1.496002662714924e-08),
        *(2.9147953450901081e-08, -6.7711997758452339e-08, 2.2900482228026655e-07),
        *(-9.9298272942317e-07, 4.5260625972231537e-06, -1.9681778105531671e-05),
        *(7.5995277030017761e-05, -0.00021503011930044477, -0.00013871931833623122),
        *(1.0103004648645344, 4.8499064014085844),
    )
    result = (w < 6.25).where(central, (w < 16.0).where(middle, tail)) * x
    return abs(x).compare("eq", 1).where(x * INFINITY, result)


_TRIGONOMETRY = ("acos", "asin", "atan", "atan2", "cos", "sin", "tan")
_EXPONENTIAL = ("erf", "erf_inv", "exp", "expm1", "log", "log1p", "logistic", "pow", "tanh")
#: dtype -> name of the operation -> (operands) -> the result
FUNCTIONS: dict[str, dict[str, Callable[..., Lanes]]] = {
    "float32": {
        **{name: _rounded(name) for name in RARE},
        **{name: getattr(trigonometry, name) for name in _TRIGONOMETRY},
        **{name: getattr(exponential, name) for name in _EXPONENTIAL},
    },
    "float64": {
        **{name: _library(name) for name in _LIBRARY},
        "erf_inv": _erf_inv,
        "logistic": _logistic,
    },
}
