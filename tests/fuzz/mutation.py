"""Random damage to the bytes of a file, or to the values that its format stores."""

import json
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
import onnx
from google.protobuf.message import DecodeError, Message

Rng = np.random.Generator
Mutate = Callable[[bytes, Rng], bytes]
T = TypeVar("T")

NUMBERS = (
    0,
    1,
    -1,
    2,
    7,
    8,
    127,
    128,
    255,
    256,
    1000,
    32767,
    65535,
    65536,
    10**6,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**62,
)
TEXTS = (
    "",
    "a",
    "\0",
    "\n",
    "../../x",
    "/etc/passwd",
    "1e999",
    "NaN",
    "\ud800",
    "é",
    "a" * 5000,
    "9" * 5000,
    "%s%n",
    "com.microsoft",
    "If",
    "Loop",
    "Conv",
    "image",
)
PATHS = (
    "/vsicurl/http://a/b.tif",
    "http://a/b.tif",
    "/vsimem/a",
    "a.vrt",
    ".",
    "R0C0.jp2",
    "IMG_R2C1.TIF",
)
TOKENS = (
    b"\0",
    b"\n",
    b'"',
    b"[",
    b"]",
    b"{",
    b"}",
    b"=",
    b".",
    b",",
    b"-",
    b"inf",
    b"nan",
    b"1e999",
    b"0x" + b"f" * 600,
    b"9" * 5000,
    b"[" * 400,
    b'{"a":' * 400,
    b"a." * 90,
    b"\xff\xff\xff\xff",
    b"\\ud800",
    b"true",
    b"null",
    b"'''",
)


def pick(options: Sequence[T], rng: Rng) -> T:
    return options[int(rng.integers(len(options)))]


def damaged(content: bytes, others: Sequence[bytes], meaning: Mutate | None, rng: Rng) -> bytes:
    """Return content with a few faults in its bytes or, if `meaning` is given, in its values."""
    for _ in range(int(rng.geometric(0.6))):
        if meaning is not None and rng.random() < 0.6:
            content = meaning(content, rng)
        else:
            content = damage_bytes(content, others, rng)
    return content[: 1 << 18]


def damage_bytes(content: bytes, others: Sequence[bytes], rng: Rng) -> bytes:
    """Flip, overwrite, insert, cut out, repeat or cut off bytes, or take some from another file."""
    a, b = sorted(int(rng.integers(0, len(content) + 1)) for _ in range(2))
    b = min(b, a + int(2 ** rng.uniform(0, 10)))
    other = pick(others, rng)
    c = int(rng.integers(0, len(other) + 1))
    number = pick(NUMBERS, rng)
    order = "<>"[int(rng.integers(2))]
    width = int(rng.integers(4))
    packed = struct.pack(f"{order}{'BHIQ'[width]}", number % 2 ** (8 << width))
    token = pick(TOKENS, rng)
    flipped = bytes([content[a] ^ (1 << int(rng.integers(8)))]) if a < len(content) else b""
    choices = (
        content[:a] + flipped + content[a + 1 :],
        content[:a] + rng.bytes(1) + content[a + 1 :],
        content[:a] + packed + content[a + len(packed) :],
        content[:a] + token + content[a:],
        content[:a] + rng.bytes(b - a) + content[a:],
        content[:a] + content[b:],
        content[:b] + content[a:b] * int(rng.integers(1, 30)) + content[b:],
        content[:a] + other[c : c + b - a] + content[b:],
        content[:a],
    )
    return pick(choices, rng)


def damage_json(content: bytes, rng: Rng) -> bytes:
    """Change one value of a document or its place. Content that is no JSON is not changed."""
    try:
        return json.dumps(_tree(json.loads(content), rng)).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return content


def damage_xml(content: bytes, rng: Rng) -> bytes:
    """Change the text, name, place or an attribute of an element. Content that is no XML is not
    changed.
    """
    try:
        root = ET.fromstring(content)  # noqa: S314 - our own seeds, damaged
    except (ET.ParseError, ValueError, LookupError):
        return content
    pairs = []
    for parent in root.iter():
        pairs += [(parent, child) for child in parent]
    if not pairs:
        return content
    (parent, child), (_, other) = (pick(pairs, rng) for _ in range(2))
    texts = (*map(str, NUMBERS), *TEXTS, *PATHS, other.text or "")
    text = pick(texts, rng)
    kind = rng.random()
    if kind < 0.1:
        parent.remove(child)
    elif kind < 0.2:
        # A copy is appended, because an element within itself is no tree.
        parent.append(deepcopy(other))
    elif kind < 0.3:
        child.tag = other.tag
    elif child.attrib and kind < 0.65:
        child.set(pick(sorted(child.attrib), rng), text)
    else:
        child.text = text
    return bytes(ET.tostring(root))


def damage_safetensors(content: bytes, rng: Rng) -> bytes:
    """Change the header or the JSON within its metadata, and adapt the header's length."""
    # A safetensors file begins with the length of its header, 8 bytes little-endian.
    size = int.from_bytes(content[:8], "little")
    header = damage_json(content[8 : 8 + size], rng)
    if rng.random() < 0.5:
        try:
            tree = json.loads(header)
            inner = tree["__metadata__"]
            key = pick(sorted(inner), rng)
            inner[key] = damage_json(inner[key].encode(), rng).decode()
            header = json.dumps(tree).encode()
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            pass
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


def damage_tiff(content: bytes, rng: Rng) -> bytes:
    """Change the tag, type, count or value of an entry in the first directory.

    Content that is no classic little-endian TIFF is not changed.
    """
    if content[:4] != b"II*\0" or len(content) < 8:
        return content
    # Bytes 4 to 7 are the offset of the first directory: a count, and entries of 12 bytes.
    start = int.from_bytes(content[4:8], "little")
    count = int.from_bytes(content[start : start + 2], "little")
    if not 0 < count < 100:
        return content
    at = start + 2 + 12 * int(rng.integers(count))
    field, width = ((0, 2), (2, 2), (4, 4), (8, 4))[int(rng.choice(4, p=(0.1, 0.1, 0.2, 0.6)))]
    number = pick(NUMBERS, rng) if rng.random() < 0.7 else int(rng.integers(70_000))
    value = (number % 2 ** (8 * width)).to_bytes(width, "little")
    if field == 0 and rng.random() < 0.5:
        tags = (256, 257, 258, 259, 277, 278, 284, 317, 322, 323, 330, 339, 50838)
        value = int(rng.choice(tags)).to_bytes(2, "little")
    return b"".join((content[: at + field], value, content[at + field + width :]))


def damage_onnx(content: bytes, rng: Rng) -> bytes:
    """Change one field somewhere in a model. Content that is no model is not changed."""
    model = onnx.ModelProto()
    try:
        model.ParseFromString(content)
        _field(model, rng)
        return bytes(model.SerializeToString())
    except (DecodeError, ValueError, TypeError):
        return content


def _field(message: Message, rng: Rng) -> None:
    """Descend at random through a message, and change the last field."""
    fields = [pair for pair in message.ListFields() if rng.random() < 0.8]
    if not fields or rng.random() < 0.05:
        _set(message, pick(message.DESCRIPTOR.fields, rng), rng)
        return
    descriptor, value = pick(fields, rng)
    if not descriptor.is_repeated:
        _field(value, rng) if isinstance(value, Message) else _set(message, descriptor, rng)
        return
    place = int(rng.integers(len(value)))
    kind = rng.random()
    if kind < 0.1:
        del value[place]
    elif kind < 0.2:
        value.extend([value[place]])
    elif isinstance(value[place], Message):
        _field(value[place], rng)
    else:
        value[place] = _like(value[place], rng)


def _set(message: Message, descriptor: Any, rng: Rng) -> None:
    """Set a field, whether it was present or not. A message in it is added empty."""
    old = getattr(message, descriptor.name)
    if descriptor.cpp_type == descriptor.CPPTYPE_MESSAGE:
        old.add() if descriptor.is_repeated else old.SetInParent()
    elif not descriptor.is_repeated:
        is_enum = descriptor.cpp_type == descriptor.CPPTYPE_ENUM
        setattr(message, descriptor.name, int(rng.integers(0, 30)) if is_enum else _like(old, rng))


def _like(value: object, rng: Rng) -> object:
    if isinstance(value, int):
        return pick(NUMBERS, rng)
    if isinstance(value, float):
        return float(rng.choice((0.0, -1.0, 1e38, np.inf, np.nan, 1e-40)))
    text = pick(TEXTS, rng)
    return (
        damage_bytes(value, [value], rng)
        if isinstance(value, bytes)
        else text.encode("utf-8", "ignore").decode()
    )


def _tree(value: object, rng: Rng) -> object:
    """Return a document with one value changed, dropped, repeated or wrapped in lists."""
    if not isinstance(value, dict | list) or not value or rng.random() >= 0.85:
        return _leaf(value, rng)
    if isinstance(value, dict):
        key = pick(list(value), rng)
        kind = rng.random()
        if kind < 0.1:
            return {name: inner for name, inner in value.items() if name != key}
        return {
            **value,
            **({pick(TEXTS, rng): value[key]} if kind < 0.2 else {key: _tree(value[key], rng)}),
        }
    place = int(rng.integers(len(value)))
    kind = rng.random()
    if kind < 0.2:
        return value[:place] + value[place + 1 :] if kind < 0.1 else value + value[place:]
    return [*value[:place], _tree(value[place], rng), *value[place + 1 :]]


def _leaf(value: object, rng: Rng) -> object:
    """Return another value, or the same value within lists."""
    for _ in range(int(rng.choice((1, 40, 400)))):
        value = [value]
    infinite = (1e308, float("nan"), float("inf"), 10**400, 2**63)
    return pick((None, True, [], {}, "", -1, 0, *infinite, value, pick(TEXTS, rng)), rng)
