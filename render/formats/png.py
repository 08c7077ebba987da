"""A compiled encoder of PNG files, several times as fast as those of libraries.

A row is stored as its differences from the row above. Single bytes and runs of equal bytes then share one
Huffman code, which is made for each picture. The encoder computes with whole numbers alone, so that a picture
has the same bytes on every machine; libraries choose how they compress by the processor.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy.typing import NDArray

from handsim.kernels import kernel
from render.frames import Bytes, Integers

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_ZLIB: Final = b"\x78\x01"
_GRAY, _COLORS = 0, 2  # PNG's types of color
# A symbol of DEFLATE is a byte, the end of a block, or the length of a run; 285 is the longest run alone.
_END, _LONGEST_SYMBOL, _SYMBOLS = 256, 285, 286
_SHORTEST, _LONGEST = 3, 258  # lengths of runs [bytes]
_ADLER: Final = 65521  # largest prime below 2^16
_MOST_BITS: Final = 15  # length of the longest code [bits]
_TOKENS: Final = _END + _LONGEST + 1  # bytes, the end, and 256 + length for runs
_HEADER_WORDS: Final = 48  # room for the code's lengths and the last word


def encode_png(
    picture: UInt8[np.ndarray, "H W 3"] | UInt16[np.ndarray, "H W"], *, text: dict[str, str] | None = None
) -> bytes:
    """A PNG file of eight-bit colors or of sixteen-bit gray, with texts by their keywords."""
    height, width = picture.shape[:2]
    bits, kind = (8, _COLORS) if picture.ndim == 3 else (16, _GRAY)
    content = picture if bits == 8 else picture.astype(">u2")  # the high byte comes first
    rows = np.ascontiguousarray(content).view(np.uint8).reshape(height, -1)
    size = height * (1 + rows.shape[1])
    words = np.empty(size // 8 + 1, np.uint64)
    words[-1] = 0  # the last word may reach beyond the data
    data = words.view(np.uint8)[:size]
    _subtract_above(rows, data.reshape(height, -1))
    tokens = np.empty(len(data) + 1, np.uint16)
    counts = np.zeros(_TOKENS, np.int64)
    length, checksum = _tokenize(data, words, tokens, counts)
    tokens = tokens[:length]
    lengths = _code_lengths(_symbol_counts(counts))
    codes, sizes = _codes(lengths)
    block = np.empty(_HEADER_WORDS + int(counts @ sizes.astype(np.int64)) // 32, np.uint32)
    length = _write_block(tokens, lengths, codes | sizes << np.uint64(32), block)
    packed = _ZLIB + block.astype("<u4", copy=False).tobytes()[:length] + struct.pack(">I", checksum)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0))]
    chunks += [(b"tEXt", f"{word}\0{line}".encode("latin-1")) for word, line in (text or {}).items()]
    return _SIGNATURE + b"".join(_chunk(*chunk) for chunk in (*chunks, (b"IDAT", packed), (b"IEND", b"")))


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(content, zlib.crc32(name))
    return b"".join((struct.pack(">I", len(content)), name, content, struct.pack(">I", checksum)))


@kernel
def _subtract_above(rows: Bytes, filtered: Bytes) -> None:
    """Write the differences of rows (H, N) from those above, each after its filter's number (H, 1 + N)."""
    # The filter Up subtracts the row above.
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    for row in range(1, len(rows)):
        into, here, above = filtered[row, 1:], rows[row], rows[row - 1]
        for n in range(len(here)):
            into[n] = here[n] - above[n]


@kernel
def _tokenize(data: Bytes, words: NDArray[np.uint64], tokens: NDArray[np.uint16], counts: Integers) -> Any:
    """Turn bytes into counted tokens for compression; return how many there are and Adler's checksum.

    `words` hold the same bytes, eight in each, followed by zeros.
    """
    count = place = 0
    total, weighted = np.int64(1), np.int64(0)  # Adler's sums; 63 bits hold those of 250 million bytes
    while place < len(data):
        value = np.int64(data[place])
        tokens[count] = value
        counts[value] += 1
        count += 1
        place += 1
        total += value
        weighted += total
        if place == len(data) or data[place] != value:
            continue
        start = place
        while place < len(data) and data[place] == value:
            place += 1
            if value == 0 and place & 7 == 0:  # most of a picture is empty
                while place + 8 <= len(data) and words[place >> 3] == 0:
                    place += 8
        run = place - start
        weighted += run * total + value * (run * (run + 1) // 2)
        total += run * value
        while run >= _SHORTEST:
            length = min(run, _LONGEST)
            tokens[count] = _END + length
            counts[_END + length] += 1
            count += 1
            run -= length
        for _ in range(run):
            tokens[count] = value
            counts[value] += 1
            count += 1
    tokens[count] = _END
    counts[_END] += 1
    return count + 1, (weighted % _ADLER) << 16 | total % _ADLER


@kernel
def _symbol_counts(counts: Integers) -> Any:
    """Counts of symbols (286,) from those of tokens (515,)."""
    symbols = np.zeros(_SYMBOLS, np.int64)
    symbols[: _END + 1] = counts[: _END + 1]
    for length in range(_SHORTEST, _LONGEST + 1):
        symbols[_run_symbol(length)[0]] += counts[_END + length]
    return symbols


@kernel
def _run_symbol(length: int) -> Any:
    """DEFLATE's symbol of a run, the number of bits that follow it, and their value."""
    if length == _LONGEST:
        return _LONGEST_SYMBOL, 0, 0
    beyond, bits = length - _SHORTEST, 0
    while beyond >> bits >= 8:
        bits += 1
    symbol = _END + 1 + 4 * bits + (beyond >> bits)
    return symbol, bits, beyond & ((1 << bits) - 1)


@kernel
def _code_lengths(counts: Integers) -> Any:
    """Lengths [bits] (286,) of the Huffman codes of symbols by their counts, two or more of which occur."""
    lengths = np.zeros(len(counts), np.int64)
    order = np.argsort(counts, kind="mergesort")
    order = order[counts[order] > 0]
    leaves = len(order)
    weights, parents = np.empty(2 * leaves - 1, np.int64), np.empty(2 * leaves - 1, np.int64)
    weights[:leaves] = counts[order]
    depths = np.zeros(2 * leaves - 1, np.int64)
    depths[0] = _MOST_BITS + 1
    while depths[:leaves].max() > _MOST_BITS:
        leaf, inner = 0, leaves  # the lightest leaf and inner node without a parent
        for node in range(leaves, 2 * leaves - 1):
            weights[node] = 0
            for _ in range(2):
                if leaf < leaves and (inner == node or weights[leaf] <= weights[inner]):
                    child, leaf = leaf, leaf + 1
                else:
                    child, inner = inner, inner + 1
                weights[node] += weights[child]
                parents[child] = node
        depths[-1] = 0
        for node in range(2 * leaves - 3, -1, -1):
            depths[node] = depths[parents[node]] + 1
        weights[:leaves] = (weights[:leaves] + 1) // 2  # for another try with counts that differ less
    lengths[order] = depths[:leaves]
    return lengths


@kernel
def _codes(lengths: Integers) -> Any:
    """Codes of all tokens (515,) with the bits that follow them, the first bit lowest, and their lengths."""
    codes, sizes = np.zeros(_TOKENS, np.uint64), np.zeros(_TOKENS, np.uint64)
    symbol_codes = np.zeros(_SYMBOLS, np.int64)
    code = 0
    for bits in range(1, _MOST_BITS + 1):
        for symbol in range(_SYMBOLS):
            if lengths[symbol] == bits:
                for bit in range(bits):
                    symbol_codes[symbol] |= ((code >> bit) & 1) << (bits - 1 - bit)
                code += 1
        code <<= 1
    for token in range(_TOKENS):
        symbol, bits, value, distance = token, 0, 0, 0
        if token > _END:
            if token < _END + _SHORTEST:
                continue
            symbol, bits, value = _run_symbol(token - _END)
            distance = 1  # a single zero bit stands for the only distance, one byte
        codes[token] = symbol_codes[symbol] | (value << lengths[symbol])
        sizes[token] = lengths[symbol] + bits + distance
    return codes, sizes


@kernel
def _write_block(
    tokens: NDArray[np.uint16], lengths: Integers, codes: NDArray[np.uint64], block: NDArray[np.uint32]
) -> int:
    """Write a block with its code, 32 bits a word from the lowest on, and return its number of bytes.

    `codes` have their lengths in the upper half.
    """
    # The block is the last one, of type 2. The lengths of the codes are themselves codes, of four bits each.
    header = np.zeros((24 + _SYMBOLS + 1, 2), np.uint64)
    header[0], header[1], header[2], header[4] = (1, 1), (2, 2), (_SYMBOLS - 257, 5), (15, 4)
    header[3, 1] = 5
    for n in range(19):
        header[5 + n] = (0 if n < 3 else 4, 3)
    for n in range(_SYMBOLS + 1):
        length = lengths[n] if n < _SYMBOLS else 1
        backwards = (length & 1) << 3 | (length & 2) << 1 | (length & 4) >> 1 | (length & 8) >> 3
        header[24 + n] = (backwards, 4)
    held, count, place = np.uint64(0), np.uint64(0), 0
    for n in range(len(header)):
        held, count, place = _put(header[n, 0], header[n, 1], held, count, place, block)
    low = np.uint64(0xFFFFFFFF)
    for token in tokens:
        held, count, place = _put(
            codes[token] & low, codes[token] >> np.uint64(32), held, count, place, block
        )
    block[place] = np.uint32(held)
    return 4 * place + int(count + np.uint64(7)) // 8


@kernel
def _put(
    value: np.uint64,
    bits: np.uint64,
    held: np.uint64,
    count: np.uint64,
    place: int,
    block: NDArray[np.uint32],
) -> Any:
    """Append bits to those that are held back, and write a word when it is full, without a branch."""
    held |= value << count
    count += bits
    block[place] = np.uint32(held)
    full = count >> np.uint64(5)
    held >>= full << np.uint64(5)
    return held, count & np.uint64(31), place + np.int64(full)
