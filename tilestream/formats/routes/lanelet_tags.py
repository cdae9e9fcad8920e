"""Tags into the lanelets of a Lanelet2 map; every other byte stays as it is."""

import codecs
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.parsers.expat import ExpatError, ParserCreate
from xml.sax.saxutils import escape

from tilestream.errors import CorruptSourceError

START_TAG = re.compile(rb"""<[^"'>]*(?:"[^"]*"[^"'>]*|'[^']*'[^"'>]*)*>""")
END_TAG = re.compile(rb"</[^>]*>")
ENCODING = re.compile(rb"""^<\?xml[^>]*\bencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
MARKS = {
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}
"""Encodings that a file begins with; the mark itself stays the first letter of the text."""
NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML may have."""
NOT_TEXT = {'"': "&quot;", "'": "&apos;", "\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}


@dataclass(frozen=True)
class _Child:
    """An element in a relation: where it is in the file [bytes]."""

    start: int
    end: int
    key: str
    """Of a tag its `k`, else empty."""


@dataclass
class _Relation:
    """A relation that is being read."""

    number: str
    there: bool
    """Whether no editor has marked it as deleted."""
    children: list[_Child] = field(default_factory=list)


def with_tags(content: bytes, tags: Mapping[str, Mapping[str, str]], prefix: str) -> bytes:
    """A Lanelet2 map with tags of ours in its relations, the last in each, written as the elements
    before them: indentation, ends of lines, quotes. Tags of ours that were there are taken away
    first, so that a second time gives the same bytes.

    Args:
        content: the file.
        tags: by the number of a relation, keys (each with the prefix) and values.
        prefix: of the keys of all tags that are ours.

    Raises:
        CorruptSourceError: no XML, or its text is not in the encoding that it names.
    """
    encoding = next((name for mark, name in MARKS.items() if content.startswith(mark)), None)
    named = ENCODING.match(content.removeprefix(codecs.BOM_UTF8))
    encoding = encoding or (named[1].decode() if named else "utf-8")
    try:
        data = content.decode(encoding).encode("utf-8")
    except (LookupError, UnicodeError) as error:
        raise CorruptSourceError(f"its text is not {encoding} ({error})") from error
    parts, last = [], 0
    for start, end, new in _edits(data, tags, prefix):
        parts += [data[last:start], new]
        last = end
    text = b"".join([*parts, data[last:]]).decode("utf-8")
    return text.encode(encoding, "xmlcharrefreplace")


def _edits(
    data: bytes, tags: Mapping[str, Mapping[str, str]], prefix: str
) -> list[tuple[int, int, bytes]]:
    """What stands from where to where instead of what is there, in the order of the file."""
    edits: list[tuple[int, int, bytes]] = []
    for relation in _relations(data):
        ours = [child for child in relation.children if child.key.startswith(prefix)]
        others = [child for child in relation.children if not child.key.startswith(prefix)]
        cut = [(_before(data, child.start), child.end, b"") for child in ours]
        new = tags.get(relation.number, {}) if relation.there else {}
        if new and others:
            at = others[-1]
            edits.append((at.end, at.end, _like(data, at, new)))
        edits += cut
    return sorted(edits)


def _like(data: bytes, child: _Child, tags: Mapping[str, str]) -> bytes:
    """Tags, each written as an element before them."""
    space = data[_before(data, child.start) : child.start]
    raw = data[child.start : child.end]
    quote = "'" if b"'" in raw and b'"' not in raw else '"'
    end = " />" if raw.endswith(b" />") else "/>"
    written = b""
    for key, value in tags.items():
        texts = (escape(NOT_XML.sub("\ufffd", text), NOT_TEXT) for text in (key, value))
        k, v = (f"{quote}{text}{quote}" for text in texts)
        written += space + f"<tag k={k} v={v}{end}".encode()
    return written


def _before(data: bytes, start: int) -> int:
    """Where the white space before an element begins."""
    while start and data[start - 1] in b" \t\r\n":
        start -= 1
    return start


def _relations(data: bytes) -> list[_Relation]:
    """The relations of a file of UTF-8, with where their elements are."""
    found: list[_Relation] = []
    path: list[tuple[str, int, Mapping[str, str]]] = []
    parser = ParserCreate("utf-8")

    def start(name: str, attributes: Mapping[str, str]) -> None:
        path.append((name, parser.CurrentByteIndex, attributes))
        if name == "relation":
            deleted = attributes.get("action") == "delete" or attributes.get("visible") == "false"
            found.append(_Relation(str(attributes.get("id")), not deleted))

    def end(name: str) -> None:
        _, begun, attributes = path.pop()
        if not path or path[-1][0] != "relation":
            return
        opening = START_TAG.match(data, begun)
        closing = opening
        if opening is not None and not opening[0].endswith(b"/>"):
            closing = END_TAG.match(data, parser.CurrentByteIndex)
        if closing is None:
            raise CorruptSourceError(f"byte {begun}: an element that comes from an entity")
        key = str(attributes.get("k")) if name == "tag" else ""
        found[-1].children.append(_Child(begun, closing.end(), key))

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(data, True)
    except ExpatError as error:
        raise CorruptSourceError(f"no OSM XML ({error})") from error
    return found
