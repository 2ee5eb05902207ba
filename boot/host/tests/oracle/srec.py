"""Reads S-records with PyPI's bincopy; prints address, length and CRC-32 of each run, or `refused`."""

import sys
import zlib

import bincopy

for path in sys.argv[1:]:
    try:
        file = bincopy.BinFile()
        with open(path, encoding="latin-1", newline="") as text:
            file.add_srec(text.read())
        runs = [f"{s.address:08X}:{len(s.data)}:{zlib.crc32(s.data):08X}" for s in file.segments]
        print(" ".join(runs) or "empty")
    except Exception:
        print("refused")
