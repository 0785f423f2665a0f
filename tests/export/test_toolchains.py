"""Exports under the compilers, analysers and emulators that a control unit's engineer would try
them with.
"""

import re

import pytest
from exports import FAMILIES, STRICT, Export, command, tool
from footprint import CORTEX_M4F, HOST, TARGETS, footprint, worst_stack

from vehest.export.program import TOLERANCES, program_files

pytestmark = pytest.mark.export
PRECISIONS = ("double", "float")
MOST_STACK = 6 * 1024  # bytes
LIBRARY = {
    "sqrt",
    "exp",
    "log",
    "log10",
    "log1p",
    "pow",
    "sin",
    "cos",
    "tan",
    "atan",
    "atan2",
    "tanh",
    "floor",
    "rint",
    "fabs",
}
MERGED = {"sincos"}  # what gcc makes of both of an angle
MEMORY = {"memset", "memcpy", "memmove"}
ARM = [*CORTEX_M4F.options, "-ffp-contract=off"]
BOARD = [
    "qemu-system-arm",
    "-machine",
    "mps2-an386",
    "-icount",
    "shift=0",
    "-nographic",
    "-monitor",
    "none",
    "-serial",
    "none",
]
MIPS = "mips-linux-gnu-gcc"


@pytest.fixture
def place(tmp_path, request):
    """Folder of these tests, whose sources in C lie beside them."""
    return request.path.parent


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("family", FAMILIES)
def test_no_compiler_warns_of_anything(tmp_path, family, precision, compiler):
    Export(family, precision, tmp_path).write().build(compiler)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("family", FAMILIES)
def test_senseless_samples_break_neither_memory_nor_contract(tmp_path, place, family, precision):
    _fuzz(Export(family, precision, tmp_path), place, 10_000)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_a_million_senseless_samples_break_neither_memory_nor_contract(tmp_path, place, family):
    _fuzz(Export(family, "double", tmp_path), place, 1_000_000, "-O2")


def _fuzz(export, place, steps, *options):
    export.write()
    options = (
        "-g",
        "-fsanitize=address,undefined,float-cast-overflow",
        "-fno-sanitize-recover=all",
        "-I.",
        *options,
    )
    program = export.build("gcc", *options, main=str(place / "fuzz.c"), out="fuzz")
    assert f"{steps} steps" in command([str(program), str(steps), "7"], export.folder, 3600.0)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("family", FAMILIES)
def test_the_stack_is_bounded_and_nothing_is_allocated(tmp_path, family, precision):
    tool("gcc")
    files = program_files(Export(family, precision, tmp_path).stepper(), precision, family)
    footprints = [
        size for size in (footprint(files, target) for target in TARGETS) if size is not None
    ]
    assert footprints
    for size in footprints:
        assert size.data == 0
        assert size.stack <= MOST_STACK
        functions = {
            name.removesuffix("f") for name in size.library if not name.startswith("__aeabi_")
        }
        assert functions <= LIBRARY | {name.removesuffix("f") for name in LIBRARY} | MEMORY | MERGED


def test_the_deepest_chain_of_calls_counts_and_recursion_is_refused():
    node = 'node: {{ title: "{0}" label: "{0}\\nx.c:1:1\\n{1} bytes (static)" }}'
    edge = 'edge: {{ sourcename: "{0}" targetname: "{1}" }}'
    nodes = [
        node.format(*pair) for pair in (("main", 16), ("left", 100), ("right", 40), ("leaf", 70))
    ]
    edges = [
        edge.format(*pair)
        for pair in (("main", "left"), ("main", "right"), ("right", "leaf"), ("leaf", "sqrt"))
    ]
    graph = "\n".join([*nodes, 'node: { title: "sqrt" label: "sqrt" }', *edges])
    assert worst_stack([graph], ["main"]) == (126, ("sqrt",))
    with pytest.raises(RecursionError, match="calls itself"):
        worst_stack([graph + edge.format("leaf", "right")], ["main"])


@pytest.mark.parametrize("family", FAMILIES)
def test_a_big_endian_machine_of_32_bits_finds_the_same(tmp_path, family):
    export = Export(family, "double", tmp_path).write()
    emulator = tool("qemu-mips")
    export.build(MIPS, "-O2", "-static", out="main_mips")
    export.vectors()
    largest, n_different = export.differences([emulator, "./main_mips"])
    assert largest.max() <= TOLERANCES["double"]
    assert n_different == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_cortex_m4f_without_an_operating_system_finds_the_same(tmp_path, place, family):
    export = Export(family, "double", tmp_path).write()
    export.vectors()
    output = run_on_board(export, place / "cortex_m4")
    largest, n_different = export.compared()
    assert largest.max() <= TOLERANCES["double"]
    assert n_different == 0
    assert int(re.search(r"instructions a step: (\d+)", output)[1]) > 100


def run_on_board(export, board):
    """Build an export for the board that QEMU has, run in.csv to out.csv there, return what was
    said.
    """
    compiler = tool("arm-none-eabi-gcc")
    emulator = tool(BOARD[0])
    options = [*STRICT, *ARM, "-I."]
    command([compiler, *options, "-c", *export.sources], export.folder)
    command([compiler, *options, "-include", str(board / "count.h"), "-c", "main.c"], export.folder)
    command([compiler, "-std=gnu99", *ARM, "-I.", "-c", str(board / "board.c")], export.folder)
    objects = ["main.o", "board.o", *(name.replace(".c", ".o") for name in export.sources)]
    command(
        [
            compiler,
            *ARM,
            "--specs=rdimon.specs",
            "-T",
            str(board / "board.ld"),
            *objects,
            "-lm",
            "-o",
            "main.elf",
        ],
        export.folder,
    )
    arguments = "enable=on,target=native,arg=main,arg=in.csv,arg=out.csv"
    return command(
        [emulator, *BOARD[1:], "-semihosting-config", arguments, "-kernel", "main.elf"],
        export.folder,
    )


def test_sizes_are_those_of_the_linked_objects(tmp_path):
    tool("gcc")
    files = program_files(Export("kinematic", "double", tmp_path).stepper(), "double", "x")
    footprint_of_host = footprint(files, HOST)
    assert 4_000 < footprint_of_host.code < 40_000
    assert 1_000 < footprint_of_host.state < 10_000
