"""Zip files that claim other than what they hold."""

import bz2
import struct
import zipfile
import zlib

COMPRESSORS = {
    zipfile.ZIP_BZIP2: bz2.BZ2Compressor,
    zipfile.ZIP_DEFLATED: lambda: zlib.compressobj(9, zlib.DEFLATED, -15),
}


def lying_zip(path, name, honest, method, size):
    """Writes a zip of one member that claims the bytes `honest`, and unpacks to `size` zeros."""
    compressor = COMPRESSORS[method]()
    blocks = [compressor.compress(bytes(1 << 24)) for _ in range(size >> 24)]
    data = b"".join([*blocks, compressor.flush()])
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr(name, honest)
        (entry,) = archive.infolist()
    content = path.read_bytes()
    start = content.index(name.encode()) + len(name)
    head, tail = content[:start], content[start + entry.compress_size :]
    lengths = struct.pack("<I", entry.compress_size), struct.pack("<I", len(data))
    moved = struct.pack("<I", start + entry.compress_size), struct.pack("<I", start + len(data))
    tail = tail.replace(*lengths).replace(*moved)
    path.write_bytes(head.replace(*lengths) + data + tail)
    return path
