"""Data blocks of an MDF file, plain or deflated, as records: unpacked piece by piece, never beyond what the blocks announce."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vehest.data.limits import check_limit, check_unpacked
from vehest.sources.mdf.blocks import BlockFile
from vehest.sources.mdf.layout import Group, Piece

Bytes = NDArray[np.uint8]

CHUNK = 4 * 2**20
MOST_AT_ONCE = 64 * 2**20  # of a transposed block or of one record; the standard says blocks of 4 MiB
MOST_DEFLATED = 1040  # times: no deflated byte stands for more


def records_of(file: BlockFile, pieces: Sequence[Piece], group: Group, wanted: int | None) -> Iterator[Bytes]:
    """A group's records without their numbers, shape (N, record and invalidation bytes), some at a time.

    Args:
        file: that holds them.
        pieces: data blocks of the group and those that share its blocks.
        group: whose records are taken.
        wanted: how many are there; None for as many as there are.

    Raises:
        DataError: they are damaged, or more than the limits.
    """
    length = group.record_bytes + group.invalidation_bytes
    if max(length, CHUNK) > MOST_AT_ONCE:
        raise file.damaged(f"group {group.title} announces records of {length} bytes")
    announced = sum(piece.unpacked for piece in pieces)
    if announced > file.size or any(piece.is_deflated for piece in pieces):
        check_unpacked(file.path, file.size, announced)
    if wanted is not None:
        check_limit("samples", wanted, f"'{file.path}': group {group.title} announces {wanted} samples")
    chunks = (chunk for piece in pieces for chunk in _content(file, piece))
    found = _mixed(file, chunks, group) if group.data.id_bytes else _alike(chunks, length)
    count = 0
    for records in found:
        kept = records if wanted is None else records[: wanted - count]
        count += len(kept)
        check_limit("samples", count, f"'{file.path}': group {group.title} holds {count} samples or more")
        yield kept
        if wanted is not None and count >= wanted:
            return


def _content(file: BlockFile, piece: Piece) -> Iterator[bytes]:
    """What a block stands for, some at a time."""
    if not piece.is_deflated:
        for start in range(0, piece.packed, CHUNK):
            yield file.read(piece.address + start, min(CHUNK, piece.packed - start))
    elif piece.columns < 2:
        yield from _inflated(file, piece)
    else:
        if piece.unpacked > MOST_AT_ONCE:
            raise file.unsupported(
                f"holds a transposed block of {piece.unpacked} bytes", "write blocks of at most 4 MiB, as the standard says"
            )
        block = np.frombuffer(b"".join(_inflated(file, piece)), np.uint8)
        rows = len(block) // piece.columns
        matrix = block[: rows * piece.columns].reshape(piece.columns, rows)
        yield matrix.T.tobytes() + block[rows * piece.columns :].tobytes()


def _inflated(file: BlockFile, piece: Piece) -> Iterator[bytes]:
    """A deflated block, which must hold just what it announces."""
    if piece.unpacked > MOST_DEFLATED * (piece.packed + 1):
        raise file.damaged(f"a block of {piece.packed} bytes announces {piece.unpacked}")
    inflater, count = zlib.decompressobj(), 0
    try:
        for start in range(0, piece.packed, CHUNK):
            waiting = file.read(piece.address + start, min(CHUNK, piece.packed - start))
            while waiting and not inflater.eof:
                block = inflater.decompress(waiting, CHUNK)
                waiting = inflater.unconsumed_tail
                count += len(block)
                if count > piece.unpacked:
                    raise file.damaged(f"a block unpacks to more than the {piece.unpacked} bytes it announces")
                yield block
        rest = inflater.flush()
    except zlib.error as error:
        raise file.damaged(f"a compressed block: {error}") from None
    count += len(rest)
    if count != piece.unpacked or not inflater.eof:
        raise file.damaged(f"a block unpacks to {count} bytes and announces {piece.unpacked}")
    yield rest


def _alike(chunks: Iterable[bytes], length: int) -> Iterator[Bytes]:
    """Records of one length, one after another; blocks may cut them anywhere."""
    if length == 0:
        return
    waiting = bytearray()
    for chunk in chunks:
        waiting += chunk
        whole = len(waiting) // length * length
        if whole:
            yield np.frombuffer(bytes(waiting[:whole]), np.uint8).reshape(-1, length)
            del waiting[:whole]


def _mixed(file: BlockFile, chunks: Iterable[bytes], group: Group) -> Iterator[Bytes]:
    """A group's records among those of others."""
    length = group.record_bytes + group.invalidation_bytes
    waiting, count = b"", 0
    for chunk in chunks:
        waiting += chunk
        starts, end, walked = _walk(file, waiting, group)
        count += walked
        check_limit("samples", count, f"'{file.path}': group {group.title} shares its blocks with {count} records or more")
        if starts:
            places = np.array(starts)[:, None] + np.arange(length)
            yield np.frombuffer(waiting, np.uint8)[places]
        waiting = waiting[end:]
        if len(waiting) > MOST_AT_ONCE:
            raise file.damaged(f"a record of {len(waiting)} bytes or more")


def _walk(file: BlockFile, waiting: bytes, group: Group) -> tuple[list[int], int, int]:
    """Where a group's records begin, where the last whole record ends, and how many records were passed."""
    data, record_id = group.data, group.record_id
    width, behind, sizes = data.id_bytes, data.id_bytes if data.repeated_id else 0, data.sizes
    starts: list[int] = []
    at, end, walked = 0, len(waiting), 0
    while at + width <= end:
        number = waiting[at] if width == 1 else int.from_bytes(waiting[at : at + width], "little")
        if number not in sizes:
            raise file.damaged(f"a record is numbered {number}, which no group is")
        size = sizes[number]
        if size is None:
            if at + width + 4 > end:
                break
            size = 4 + int.from_bytes(waiting[at + width : at + width + 4], "little")
        if at + width + size + behind > end:
            break
        if number == record_id:
            starts.append(at + width)
        at += width + size + behind
        walked += 1
    return starts, at, walked
