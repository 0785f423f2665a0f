"""Exported methods as shared libraries: what a C compiler makes of them, called on whole drives."""

import ctypes
import shutil
import subprocess
from dataclasses import dataclass

import numpy as np

from vehest.export import program
from vehest.export.rendering import render

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion"]
OUTPUTS = ("vy", "vx", "yaw_rate", "vy_variance")

REPLAY = """
#include "vehest_method.h"
#include <stddef.h>

size_t state_bytes(void);
void replay(void *state, int steps, const vehest_real *rows, vehest_real *out, char *fine);

size_t state_bytes(void) { return sizeof(vehest_method); }

void replay(void *state, int steps, const vehest_real *rows, vehest_real *out, char *fine)
{
    vehest_method *m = state;
    vehest_method_start(m);
    for (int k = 0; k < steps; k++) {
        vehest_method_output output;
        fine[k] = vehest_method_step(m, rows + k * VEHEST_CHANNELS, &output);
        out[4 * k] = output.vy;
        out[4 * k + 1] = output.vx;
        out[4 * k + 2] = output.yaw_rate;
        out[4 * k + 3] = output.vy_variance;
        if (!fine[k]) {
            vehest_method_start(m);
        }
    }
}
"""


@dataclass
class Library:
    """A compiled method of one precision."""

    library: ctypes.CDLL
    precision: str

    def __call__(self, rows):
        """Outputs (T, 4) in the order of `OUTPUTS` and whether each step went well (T,).

        A lost method starts anew.
        """
        dtype = np.float64 if self.precision == "double" else np.float32
        rows = np.ascontiguousarray(rows, dtype)
        out = np.empty((len(rows), 4), dtype)
        fine = np.zeros(len(rows), np.int8)
        self.library.state_bytes.restype = ctypes.c_size_t
        state = ctypes.create_string_buffer(self.library.state_bytes())
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (rows, out, fine)]
        self.library.replay(state, len(rows), *pointers)
        return out.astype(np.float64), fine.astype(bool)


def method_files(estimator, precision):
    """Name of a file -> the C of an estimator's method."""
    types = render("types.h.j2", precision, channels=program.channels_of(estimator))
    return {"vehest_types.h": types, **program.method_files(estimator, precision)}


def write(files, folder):
    """Write texts, by name; names may lead into folders."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def built(estimator, precision, folder, compiler="gcc"):
    """A library; a warning is an error."""
    write(method_files(estimator, precision) | {"replay.c": REPLAY}, folder)
    flags = [*FLAGS, *(["-Wdouble-promotion"] if precision == "float" else [])]
    library = folder / f"{compiler}.so"
    command = [
        compiler,
        *flags,
        "-fPIC",
        "-shared",
        "vehest_method.c",
        "replay.c",
        "-lm",
        "-o",
        str(library),
    ]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Library(ctypes.CDLL(str(library)), precision)
