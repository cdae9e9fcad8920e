"""Small files that would become large: each a claim, or a compression, that nobody must believe."""

import bz2
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator

import laspy
import lazrs
import lz4.frame
import zstandard
from fuzz_mutations import mcap_of, packed, paged, unpacked, zipped
from mcap.records import Chunk
from mcap.stream_reader import MAGIC_SIZE, StreamReader

LARGE = 1_600_000_000
"""What a bomb unpacks to [bytes]: more than a reader may have."""
PIECE = bytes(1 << 24)


def of_yaml(data: bytes) -> Iterator[bytes]:
    """Aliases of aliases, depth, numbers, and a value of each kind that fails in its own way."""
    ten = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12))
    aliases = f"a0: &a0 [x, x]\n{ten}\n"
    yield data + b"\n" + aliases.encode()
    yield aliases.encode() + b"map: *a11\nout: *a11\nprojector_type: *a11\nname: *a11\n"
    yield b"x: &a [*a]\nout: *a\n" + data
    for text in (
        *("[" * 100_000, "{a: " * 100_000, "- " * 100_000, "? " * 50_000),
        *("2001-99-99", "!!timestamp x", "!!bool x", "!!float x", "!!set {[a]}", "0x_", "'\\"),
        *("9" * 100_000, "0x" + "f" * 100_000, "1:" * 10_000 + "1", "<<: 1", "{[1]: 2}", "!!x y"),
        *("[" + "1," * 2_000_000 + "]", "a" * 20_000_000, "!!python/object/apply:os.abort []"),
    ):
        yield b"out: " + text.encode()
        yield text.encode()
        yield data + b"\nmap_origin: " + text.encode() + b"\nname: " + text.encode()


def of_json(data: bytes) -> Iterator[bytes]:
    """Every shape in every place."""
    shapes = (None, 1, "x", [], {}, [1], [[1, 2]], [[[1, 2], [3]]], {"a": 1}, True, 1e300)
    for shape in shapes:
        yield json.dumps(shape).encode()
        for member in ("features", "crs", "geometry", "coordinates", "properties", "geometries"):
            for kind in ("FeatureCollection", "Feature", "LineString", "GeometryCollection"):
                yield json.dumps({"type": kind, member: shape}).encode()
        line = {"type": "LineString", "coordinates": [[0, 0], [10, 0], shape]}
        yield json.dumps(line).encode()
        feature = {"type": "Feature", "properties": shape, "geometry": line, "id": shape}
        yield json.dumps({"type": "FeatureCollection", "features": [feature, shape]}).encode()
        yield json.dumps({**json.loads(data), "crs": {"properties": {"name": shape}}}).encode()
    for number in ("9" * 400, "9" * 5000, "1e400", "NaN", "-Infinity"):
        yield b'{"type": "LineString", "coordinates": [[0, 0], [%s, 1]]}' % number.encode()
    yield b"[" * 200_000
    yield b'{"type": "GeometryCollection", "geometries": [' * 400 + b"1" + b"]}" * 400
    yield json.dumps(
        {"type": "LineString", "coordinates": [[999.0 * i, 0.0] for i in range(200_000)]}
    ).encode()


def of_rows(data: bytes) -> Iterator[bytes]:
    """Long fields, other line ends, quotes that do not end, a route around the earth."""
    yield data + b'"' + b"x" * 200_000 + b'"\n'
    yield data.replace(b",", b'"', 1) + b"a,\rb\x00,c\n"
    yield b"x,y\n" + b"\n".join(b"%d,0" % (999 * i) for i in range(300_000))
    yield b"\n".join(b"1 %d 0 0 0 0 0 1" % (999 * i) for i in range(300_000))
    yield b"\xff\xfe" + data.decode().encode("utf-16-le")
    yield b"x" * 10_000_000
    yield b"1 " * 5_000_000
    yield b"x,y\n" + b"9" * 5000 + b",1\n1,1\n"


def of_osm(data: bytes) -> Iterator[bytes]:
    """Entities of entities, encodings, depth."""
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 11))
    head = f'<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY a0 "lol">{entities}]>'
    yield head.encode() + b'<osm><node id="&a10;"/>&a10;</osm>'
    large = "x" * 100_000
    head = f'<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY a "{large}">]>'
    yield head.encode() + b"<osm>" + b"&a;" * 30_000 + b"</osm>"
    yield b'<!DOCTYPE osm [<!ENTITY a SYSTEM "file:///etc/passwd">]><osm>&a;</osm>'
    for encoding in ("foo", "utf-16", "utf-7", "cp037", "big5", "idna", "unicode_escape", "hex"):
        yield f'<?xml version="1.0" encoding="{encoding}"?>'.encode() + data
    yield b"<osm>" + b"<a>" * 200_000
    yield b"<osm>" + b"<a>" * 200_000 + b"</a>" * 200_000 + b"</osm>"


def of_mcap(data: bytes) -> Iterator[bytes]:
    """Chunks of zeros and of small records, with honest claims and with lies."""
    zstd = zstandard.ZstdCompressor().compressobj(LARGE)
    unsaid = zstandard.ZstdCompressor().compressobj()
    zeros = {
        "zstd": b"".join([*(zstd.compress(p) for p in pieces()), zstd.flush()]),
        "zstd, unsaid": b"".join([*(unsaid.compress(p) for p in pieces()), unsaid.flush()]),
    }
    lz4s = lz4.frame.LZ4FrameCompressor()
    parts = [lz4s.begin(), *(lz4s.compress(p) for p in pieces()), lz4s.flush()]
    zeros["lz4"] = b"".join(parts)
    for kind, content in zeros.items():
        for claim in (100, 10**8, 2**28, LARGE, 2**32 - 1, 2**62):
            yield mcap_of([Chunk(kind.partition(",")[0], content, 0, 0, 0, claim)])
    stream = StreamReader(io.BytesIO(data[MAGIC_SIZE:]), skip_magic=True, emit_chunks=True)
    first = unpacked(next(r for r in stream.records if isinstance(r, Chunk)))
    for record in (
        struct.pack("<BQ", 5, 22) + bytes(22),  # messages without content
        struct.pack("<BQ", 99, 0),
        struct.pack("<BQ", 3, 14) + struct.pack("<HIII", 1, 0, 0, 0),
    ):
        yield mcap_of([packed("zstd", first + record * 1_000_000)])
    # a summary that is the whole file, so that its reader comes by the chunks
    chunk = Chunk("zstd", zeros["zstd"], 0, 0, 0, LARGE)
    whole = mcap_of([chunk])
    at = len(whole) - 8 - 20
    yield whole[:at] + struct.pack("<QQI", 8, 0, 0) + whole[-8:]


def of_bag(data: bytes) -> Iterator[bytes]:
    """The first chunk of a bag replaced by one that unpacks to gigabytes."""
    zeros = bz2.BZ2Compressor(9)
    bomb = b"".join([*(zeros.compress(p) for p in pieces()), zeros.flush()])
    at = data.index(b"compression=bz2")
    start = data.index(b"BZh", at)
    (size,) = struct.unpack_from("<I", data, start - 4)
    for claim in (len(bomb), size):
        yield data[: start - 4] + struct.pack("<I", claim) + bomb + data[start + size :]
    grown = len(bomb) - size
    moved = data[: start - 4] + struct.pack("<I", len(bomb)) + bomb + data[start + size :]
    index = data.index(b"index_pos=") + 10
    (was,) = struct.unpack_from("<Q", data, index)
    yield moved[:index] + struct.pack("<Q", was + grown) + moved[index + 8 :]


def pieces() -> Iterator[bytes]:
    """Zeros, piece by piece."""
    left = LARGE
    while left:
        yield PIECE[:left]
        left -= min(left, len(PIECE))


def of_model(data: bytes) -> Iterator[bytes]:
    """Members of zeros, with honest claims and with lies; arrays that claim too much."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    array = next(name for name in members if name.endswith(".npy"))
    packer, crc, content = zlib.compressobj(1, wbits=-15), 0, []
    for piece in pieces():
        content.append(packer.compress(piece))
        crc = zlib.crc32(piece, crc)
    deflated = b"".join([*content, packer.flush()])
    for name in (array, "schema.json"):
        for claim, its_crc in ((LARGE, crc), (100, zlib.crc32(bytes(100))), (10**8, 0)):
            yield one_member_more(data, name, deflated, claim, its_crc)
    for shape in ("(400000000,)", "(4000000000000,)", "(20000, 20000)", "(-1,)", "(1, " * 500):
        head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head
        yield zipped({**members, array: npy + bytes(64)})
    schema = members["schema.json"]
    for text in (b"[" * 1_000_000, b"[" + b"[],{}," * 4_000_000 + b"1]", b"null", b"[]", b"{}"):
        yield zipped({**members, "schema.json": text})
    for count in (10**12, -1, 10**6, 0):
        yield zipped({**members, "schema.json": with_content(schema, b"node_count", count)})
        yield zipped({**members, "schema.json": with_content(schema, b"max_depth", count)})
    twice = io.BytesIO(data)
    with zipfile.ZipFile(twice, "a", zipfile.ZIP_LZMA) as archive:
        archive.writestr("more.npy", bytes(10**6))
    yield twice.getvalue()


def with_content(schema: bytes, name: bytes, value: int) -> bytes:
    """The schema with another number in every member of this name."""
    kind = b'"__class__": "str", "__module__": "builtins", "__loader__": "JsonNode"'
    node = b'"%s": {%s, "content": "%d", "is_json": true}' % (name, kind, value)
    return re.sub(rb'"%s": \{[^{}]*\}' % name, node, schema)


def one_member_more(data: bytes, name: str, deflated: bytes, claim: int, crc: int) -> bytes:
    """An archive in which a member is this, with what it claims of itself in both its headers."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, "w") as new:
        for other in old.namelist():
            if other != name:
                new.writestr(other, old.read(other))
        info = zipfile.ZipInfo(name)
        info.compress_type, info.CRC = zipfile.ZIP_DEFLATED, crc
        info.file_size, info.compress_size = claim, len(deflated)
        info.header_offset = new.start_dir
        file.seek(new.start_dir)
        file.write(info.FileHeader(zip64=False))
        file.write(deflated)
        new.start_dir = file.tell()
        new.filelist.append(info)
        new.NameToInfo[name] = info
    return file.getvalue()


def of_e57(data: bytes) -> Iterator[bytes]:
    """Other XML in the same place: entities of entities, points without bits."""
    xml = xml_of(data)
    entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 11)).encode()
    doctype = b'<!DOCTYPE e57Root [<!ENTITY a0 "lol">' + entities + b"]>"
    head, _, tail = xml.partition(b"<e57Root")
    yield with_xml(
        data, head + doctype + b"<e57Root" + tail.replace(b"</e57Root>", b"&a10;</e57Root>")
    )
    yield with_xml(
        data, head + b"<e57Root" + tail.replace(b"</guid>", b"x" * 30_000_000 + b"</guid>", 1)
    )
    yield with_xml(data, head + b"<a>" * 100_000)
    for count in (10_000, 4 * 10**12):
        yield of_constant_points(data, count)
    for member in (b"recordCount", b"fileOffset"):
        for count in (4 * 10**12, -1, 10**20, 0):
            yield with_xml(data, re.sub(rb'%s="\d+"' % member, b'%s="%d"' % (member, count), xml))


def of_constant_points(data: bytes, count: int) -> bytes:
    """An E57 file that claims so many points, each of which takes no bits."""
    number = re.compile(rb"<(cartesian.) type=\"Float\"[^>]*?(/>|>.*?</cartesian.>)")
    xml = number.sub(rb'<\1 type="Integer" minimum="5" maximum="5">5</\1>', xml_of(data))
    return with_xml(data, re.sub(rb'recordCount="\d+"', b'recordCount="%d"' % count, xml))


def xml_of(data: bytes) -> bytes:
    """What describes the scans of an E57 file, at its end."""
    content = b"".join(data[at : at + 1020] for at in range(0, len(data), 1024))
    physical, length = struct.unpack_from("<QQ", content, 24)
    return content[physical // 1024 * 1020 + physical % 1024 :][:length]


def with_xml(data: bytes, xml: bytes) -> bytes:
    """The E57 file with another description."""
    content = b"".join(data[at : at + 1020] for at in range(0, len(data), 1024))
    (physical,) = struct.unpack_from("<Q", content, 24)
    logical = bytearray(content[: physical // 1024 * 1020 + physical % 1024] + xml)
    struct.pack_into("<QQQ", logical, 16, -(-len(logical) // 1020) * 1024, physical, len(xml))
    return paged(bytes(logical))


def of_laz(data: bytes) -> Iterator[bytes]:
    """Counts that no chunk holds, chunks that are all of the file."""
    header = laspy.LasHeader.read_from(io.BytesIO(data))
    start = header.offset_to_point_data
    vlr = lazrs.LazVlr(bytes(header.vlrs[header.vlrs.index("LasZipVlr")].record_data))
    (table_at,) = struct.unpack_from("<q", data, start)
    for count in (2**31, 2**32 - 1, 10**8):
        table = io.BytesIO()
        chunks = [(count, table_at - start - 8)]
        lazrs.write_chunk_table(table, chunks, vlr)
        forged = bytearray(data[:table_at] + table.getvalue())
        struct.pack_into("<I", forged, 107, 0)
        struct.pack_into("<Q", forged, 247, count)
        yield bytes(forged)
        vlr_at = data.index(b"laszip encoded") + 52 - 2
        for size in (2**32 - 2, 2**32 - 1, 10**9, 0, 1):
            bent = bytearray(forged)
            struct.pack_into("<I", bent, vlr_at + 12, size)
            yield bytes(bent)


def of_pcd(data: bytes) -> Iterator[bytes]:
    """Counts and sizes that no file has."""
    head, _, _ = data.partition(b"DATA")
    encodings = (b"ascii", b"binary", b"binary_compressed")
    for claim in (b"0", b"1", b"999999999999999999", b"4000000000", b"100000000"):
        lines = [
            b"%s %s" % (line.split()[0], claim) if line[:6] in (b"WIDTH ", b"POINTS") else line
            for line in head.split(b"\n")
        ]
        for encoding in encodings:
            yield b"\n".join(lines) + b"DATA " + encoding + b"\n" + bytes(1000)
        sizes = struct.pack("<II", 10_000, 2**32 - 1)
        yield b"\n".join(lines) + b"DATA binary_compressed\n" + sizes + b"\xff" * 10_000
    fields = b" ".join(b"f%d" % i for i in range(10_000))
    yield b"# .PCD\nFIELDS x y z " + fields + b"\nSIZE 4 4 4" + b" 4" * 10_000
    count = b"1 1 1 999999999999"
    yield (
        b"# .PCD\nFIELDS x y z w\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT %s\nWIDTH 1\nHEIGHT 1\n"
        b"POINTS 1\nDATA binary\n" % count
    ) + bytes(99)
    yield b"# .PCD\n" + b"#" * 10_000_000
