"""MAT files of version 5 to 7, other formats and more than the limits, read by SciPy in the limited process."""

import struct
import zlib

import numpy as np
from refusals import refusal
from scipy.io import savemat

from vehest.data.limits import Limits, use_limits
from vehest.sources.columns import Column
from vehest.sources.readers.mat_files import read_channels
from vehest.sources.revs.mat_layout import read_mat_columns


def refused(file):
    return refusal(lambda: read_mat_columns(file, ["vxCG"], Column("time", "s")))


def test_whole_numbers_come_back_as_doubles(tmp_path):
    savemat(tmp_path / "a.mat", {"s": {"one": {"value": np.arange(9, dtype="u8")[:, None], "time": np.arange(9.0)[:, None]}}})
    arrays, summary = read_channels(tmp_path / "a.mat", ["one"], "time")
    assert summary["names"] == {"one": "s.one"}
    np.testing.assert_array_equal(arrays["one.value"], np.arange(9.0))
    assert arrays["one.value"].dtype == np.float64


def test_other_formats_are_named(tmp_path):
    of_7_3 = b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x0200) + b"IM" + bytes(384) + b"\x89HDF\r\n\x1a\n"
    for content, said in ((b"time,vx\n1,2\n" * 100, "is damaged"), (of_7_3, "version 7.3")):
        (tmp_path / "a.mat").write_bytes(content)
        assert said in refused(tmp_path / "a.mat")


def test_more_than_the_limits_is_refused(tmp_path):
    stamps = np.arange(50) / 100
    savemat(tmp_path / "b.mat", {"insData": {"vxCG": {"value": stamps, "time": stamps}}}, do_compression=True)
    with use_limits(Limits(samples=49)):
        assert "raise it: limits.samples=NUMBER" in refused(tmp_path / "b.mat")
    body = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 1, 50_000_000) + struct.pack("<HHcxxx", 1, 1, b"x")
    body += struct.pack("<II", 9, 4 * 10**8) + bytes(4 * 10**8)
    packed = zlib.compress(struct.pack("<II", 14, len(body)) + body, 1)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    (tmp_path / "a.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    with use_limits(Limits(memory=300_000_000)):
        assert "takes more than" in refused(tmp_path / "a.mat")
