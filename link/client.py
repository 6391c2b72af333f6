"""Prints the robot's poses, ticks and scans: client.py /dev/ttyACM0, or client.py tcp://127.0.0.1:PORT"""
import os, random, socket, struct, sys, zlib

def frame(sequence, body):
    raw = bytes([1]) + struct.pack("<H", sequence) + body
    parts = (raw + struct.pack("<I", zlib.crc32(raw))).split(b"\0")
    return b"\0" + b"".join(bytes([len(part) + 1]) + part for part in parts) + b"\0"

def body_of(coded):
    raw, at = b"", 0
    while at < len(coded):
        raw += coded[at + 1 : at + coded[at]] + b"\0"
        at += coded[at]
    raw, check = raw[:-5], raw[-5:-1]
    return raw[3:] if len(raw) > 3 and raw[0] == 1 and struct.pack("<I", zlib.crc32(raw)) == check else None

def varint(number):
    return bytes([number]) if number < 128 else bytes([number & 127 | 128]) + varint(number >> 7)

class Fields:
    def __init__(self, body):
        self.body, self.at = body, 0
    def take(self, count):
        self.at += count
        return self.body[self.at - count : self.at]
    def number(self):  # unsigned: seven bits a byte, lowest first
        byte = self.take(1)[0]
        return byte if byte < 128 else byte & 127 | self.number() << 7
    def signed(self):  # zigzag
        number = self.number()
        return (number >> 1) ^ -(number & 1)

def show(body):
    f = Fields(body)
    kind = f.number()
    if kind == 1:
        number, at_us, samples = (f.number() for _ in range(3))
        print(f"pose {number} {at_us}", *(f"{value:.6f}" for value in struct.unpack("<3f", f.take(12))))
    elif kind == 6:
        print("ticks", f.number(), f.number(), f.signed(), f.signed(), "and", f.number(), "more")
    elif kind == 7:
        number, at_us, revolution_us, beams, first, count, bits = (f.number() for _ in range(7))
        packed = int.from_bytes(f.take(f.number()), "little")
        print("ranges", number, first, *(packed >> bits * k & (1 << bits) - 1 for k in range(count)))

def main(address):
    if address.startswith("tcp://"):
        host, port = address[6:].rsplit(":", 1)
        port = socket.create_connection((host, int(port))).makefile("rwb", buffering=0)
    else:
        os.system(f"stty -F '{address}' 921600 raw -echo")
        port = open(address, "r+b", buffering=0)
    port.write(frame(0, varint(random.getrandbits(32)) + bytes([1]) + varint(1 | 8 | 16)))  # Subscribe
    waiting = b""
    while received := port.read(4096):
        *pieces, waiting = (waiting + received).split(b"\0")
        for body in filter(None, map(body_of, pieces)):
            show(body)

main(sys.argv[1])
