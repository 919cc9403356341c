"""Programs in C and C++ of the tests, where there are compilers."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

COMPILERS = {"c": shutil.which("cc"), "c++": shutil.which("c++")}
#: Everything that a strict build asks for, in each language.
FLAGS = {"c": ["-std=c99", "-Wdouble-promotion"], "c++": ["-x", "c++", "-std=c++11"]}
STRICT = ["-O2", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror"]
needs_compiler = pytest.mark.skipif(None in COMPILERS.values(), reason="no cc or no c++ is here")


def load_library(folder, code, language="c"):
    """Compiles code without a warning, beside the headers of a folder, and loads it."""
    source = folder / "library.c"
    source.write_text(code)
    library = folder / f"library_{language}.so"
    command = [COMPILERS[language], *FLAGS[language], *STRICT, "-shared", "-fPIC", source]
    subprocess.run([*command, "-o", library, "-lm"], check=True)
    return ctypes.CDLL(library)


def pointer(array):
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_float))


#: A function for many observations, in the language that both compilers know.
_CALLS = """\
#include "{name}.h"
#ifdef __cplusplus
extern "C"
#endif
void act(int count, const float *observations, float *actions);
void act(int count, const float *observations, float *actions) {{
    for (int n = 0; n < count; n++) {{
        const float *observation = observations + n * {NAME}_OBSERVATION_SIZE;
        {call};
    }}
}}
"""
_BOUNDED = "{name}_act(observation, actions + n * {NAME}_ACTION_SIZE)"
_DISCRETE = "actions[n] = (float){name}_act(observation)"


def header_actions(header, observations, action_shape, language="c"):
    """Returns the actions [N, *action_shape] of an exported header for observations [N, O]."""
    names = {"name": header.stem, "NAME": header.stem.upper()}
    call = (_BOUNDED if action_shape else _DISCRETE).format(**names)
    library = load_library(header.parent, _CALLS.format(call=call, **names), language)
    observations = np.ascontiguousarray(observations, np.float32)
    actions = np.full((len(observations), *action_shape), np.nan, np.float32)
    library.act(len(observations), pointer(observations), pointer(actions))
    return actions
