"""Logs of a CAN bus with their DBC, and logs of a VBOX: bytes, lines, sections, numbers, clocks."""

import vbo_log
from can_drive import SIGNALS, write_log

from conftest import planar_drive
from fuzz.case import Command, generator, template
from fuzz.honest import write_yaml
from fuzz.mutations import NAMES, WRITABLE_NAMES, spoil_bytes

BUS_CHANNELS = "vx=Speed.VehSpd,yaw_rate=YawRate,ax=AccLong,ay=-AccLat"
SUFFIXES = (".asc", ".blf", ".log")
BUS = {
    "name": "logs",
    "kind": "real",
    "vehicle": "car",
    "licence": "none",
    "citation": "none",
    "source": "can",
}
BUS |= {"path": "${root}", "files": "drive.*", "dbc": "${root}/car.dbc", "rate_hz": 100}
BUS |= {"channels": {name: SIGNALS[name] for name in ("vx", "yaw_rate", "ax", "ay")}}
LINES_OF_A_LOG = (
    (b"d 8", b"d 99"), (b"Rx", b"CANFD"), (b"120", b"zzz"), (b"#", b"##9"), (b".", b".e"),
    (b"\n", b"\r"), (b"0", b"9" * 400),
)  # fmt: skip
LINES_OF_A_DBC = (
    (b"BO_ 288 IMU: 8", b"BO_ 288 IMU: 4000000000"), (b"BO_ 288 IMU: 8", b"BO_ 288 IMU: 0"),
    (b"BO_ 288", b"BO_ 99999999999"), (b"SG_ YawRate :", b"SG_ YawRate m0 :"),
    (b"SG_ YawRate :", b"SG_ YawRate M :"), (b"SG_ YawRate :", b"SG_ " + b"Y" * 500 + b" :"),
    *((b"YawRate", name.encode("utf-8", "surrogatepass")) for name in NAMES),
)  # fmt: skip
LINES_OF_A_VBO = (
    (b"[data]", b""), (b"[data]", b"[data][data]"), (b"[column names]", b"[column names]\r\n"),
    (b"[channel units]", b"[comments]"), (b" time ", b" "), (b" time ", b" time time "),
    (b"YawRate", b"\xff\xfe"), (b"{", b"{" * 500), (b"+00.031", b"+" + b"9" * 400),
    (b"+1.790", b"1e999"), (b"[header]", b"[" * 5000), (b"\r\n", b"\r"), (b"\r\n", b"\n\n"),
    (b" ", b"\t"), (b"[comments]", b"[comments]\r\n\x1b[2J"),
)  # fmt: skip
CLOCKS = (0.0, 86_395.0, 86_399.99, 43_200.0)


@template
def can(folder):
    """A drive of ten seconds in every format."""
    for suffix in SUFFIXES:
        write_log(
            planar_drive(10.0, 100.0, seed=1),
            folder / suffix[1:],
            suffix,
            jitter=0.0005,
            lost=0.003,
        )


def _swap(case, file, lines):
    """Replace one thing by another, once or everywhere; or spoil bytes."""
    if case.rng.random() < 0.5:
        case.spoil(file, spoil_bytes)
    else:
        case.spoil(
            file,
            lambda content, rng: content.replace(*rng.choice(lines), rng.choice([1, 1, 5, -1]))[
                : 4 * 2**20
            ],
        )


def _reads(case, file):
    """Commands of which one reads the file."""
    return [
        ("estimate", "pretrained", file, "dataset=logs", "-o", "out.csv"),
        ("ingest", "logs"),
        ("data", case.rng.choice(["check", "show"]), file, "dataset=logs"),
    ]


@generator("can", weight=5)
def log_of_a_bus(case):
    """A damaged log of a CAN bus, or of its DBC file."""
    suffix = SUFFIXES[case.visit % 3]
    folder = case.copy(f"can/{suffix[1:]}", "raw")
    write_yaml(case.place / "conf/dataset/logs.yaml", BUS)
    if case.rng.random() < 0.4:
        _swap(case, folder / "car.dbc", LINES_OF_A_DBC)
    elif suffix == ".blf":
        case.spoil(folder / "drive.blf", spoil_bytes)
    else:
        _swap(case, folder / f"drive{suffix}", LINES_OF_A_LOG)
    file = f"raw/drive{suffix}"
    replay = (
        "replay",
        file,
        "--dbc",
        "raw/car.dbc",
        "--signals",
        BUS_CHANNELS,
        "--speed",
        "max",
        "--quiet",
        "--out",
        "out.csv",
    )
    return Command(case.rng.choice([replay, *_reads(case, file)]))


@generator(weight=4)
def vbo(case):
    """A damaged VBO file."""
    more = {} if case.honest or case.rng.random() < 0.8 else {"clock": "interpolate"}
    write_yaml(
        case.place / "conf/dataset/logs.yaml",
        vbo_log.dataset(case.place / "raw") | {"title": "Logs"} | more,
    )
    units = vbo_log.UNITS
    if not case.honest and case.rng.random() < 0.2:
        units = tuple(" ".join(case.rng.choice(WRITABLE_NAMES).split())[:200] for _ in units)
    file = case.write("raw/lap.vbo", "")
    vbo_log.write_log(file, case.rng.choice(CLOCKS), units=units)
    _swap(case, file, LINES_OF_A_VBO)
    return Command(
        case.rng.choice(
            [
                (words[0], *words[2:]) if words[1] == "pretrained" else words
                for words in _reads(case, "raw/lap.vbo")
            ]
        )
    )
