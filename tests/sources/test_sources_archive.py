"""Archives from strangers: what is harmless comes out as it went in, all else is refused in one
line and leaves nothing behind.
"""

import stat
import tempfile
import zipfile

import pytest
from refusals import refusal

from vehest.data.limits import Limits, use_limits
from vehest.sources.archive import unpacked

CONTENT = {
    "bag/metadata.yaml": b"a: 1\n",
    "bag/data.db3": bytes(range(256)) * 40,
    "bag/deep/er/x": b"",
}


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    """A temporary folder of our own, which every test must leave empty."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


def packed(folder, *entries):
    file = folder / "bag.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in entries:
            archive.writestr(path, data)
    return file


def refused(file, **limits):
    before = sorted(file.parent.rglob("*"))
    message = refusal(unpacked(file, **limits).__enter__)
    assert str(file) in message
    assert sorted(file.parent.rglob("*")) == before
    return message


def test_what_was_packed_comes_out_and_is_gone_afterwards(tmp_path):
    file = packed(tmp_path, *CONTENT.items())
    with unpacked(file) as folder:
        unpacked_contents = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file()
        }
        assert unpacked_contents == CONTENT
    assert not folder.exists()


def special(kind):
    entry = zipfile.ZipInfo("bag/data.db3")
    entry.external_attr = (kind | 0o777) << 16
    return entry


@pytest.mark.parametrize(
    "name",
    ["../evil", "/etc/evil", "C:\\evil", "a/\x1b[2J", special(stat.S_IFLNK), special(stat.S_IFIFO)],
)
def test_names_that_leave_the_folder_links_and_special_files_are_refused(tmp_path, name):
    assert "is no file inside the folder" in refused(
        packed(tmp_path, ("bag/metadata.yaml", b""), (name, b"/etc/passwd"))
    )
    assert not (tmp_path.parent / "evil").exists()


def test_more_bytes_or_entries_than_the_limit_or_than_the_archive_s_own_size_allows_are_refused(
    tmp_path,
):
    file = packed(tmp_path, ("zeros", bytes(10**6)), ("more", bytes(10**6)))
    assert file.stat().st_size < 10**4
    assert "0.002 GB unpacked, more than the limit of 10000 entries and 0.0015 GB" in refused(
        file, most_bytes=1_500_000
    )
    with unpacked(file, most_bytes=2_000_000) as folder:
        assert (folder / "more").stat().st_size == 10**6
    zeros = packed(tmp_path, ("zeros", bytes(80 * 2**20)))
    assert "0.0839 GB unpacked, more than the limit of 10000 entries and 0.0671 GB" in refused(
        zeros
    )
    with use_limits(Limits(text_bytes=10_000)):
        assert "holds a list of entries of" in refused(
            packed(tmp_path, *((f"{k:0100d}", b"") for k in range(200)))
        )


def test_an_archive_that_understates_its_size_is_refused(tmp_path):
    file = packed(tmp_path, ("data.db3", bytes(10**6)))
    raw = bytearray(file.read_bytes())
    for at in (raw.index(b"PK\x03\x04") + 22, raw.index(b"PK\x01\x02") + 24):
        raw[at : at + 4] = (10).to_bytes(4, "little")
    file.write_bytes(raw)
    assert "not a sound zip archive" in refused(file)


def test_entries_packed_by_a_method_whose_memory_an_entry_chooses_are_refused(tmp_path):
    file = tmp_path / "bag.zip"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("data.db3", bytes(1000))
    assert "by another method than deflate; unpack it by hand" in refused(file)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("data.db3", bytes(1000))
    with unpacked(file) as folder:
        assert (folder / "data.db3").read_bytes() == bytes(1000)
