"""Machines with real links: one network namespace each, and a hub that passes their IP packets on.

    hub.py NAME:HOST ...

Makes the namespace NAME with the interface `wire` and the address 10.99.0.HOST/24 (and HOST + 100, for a machine that
moves) for each machine; `ip netns exec NAME` runs a program there. Then it prints `ready` and takes lines from standard
input: `A B DELAY_MS LOSS` (LOSS is a share, 0 to 1; 1 cuts the link) changes the link between two machines, both ways;
`A KBIT_S` is the rate at which a machine sends, and at which it receives, to and from all others (0: without a limit).
What is faster waits in a queue, and is dropped if that is full. The namespaces end with the hub. It needs root.
"""

import fcntl
import heapq
import os
import random
import selectors
import struct
import subprocess
import sys
import time

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 1, 0x1000
#: Bytes that wait for a link with a rate, each way. Ours: as in a modem, half a second at 1 Mbit/s.
QUEUE_BYTES = 1 << 16


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def machine(name: str, host: int) -> int:
    """The open end of the interface of a new namespace."""
    interface = f"hub{host}-{os.getpid()}"
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", interface.encode(), IFF_TUN | IFF_NO_PI))
    ip("netns", "add", name)
    ip("link", "set", interface, "netns", name, "name", "wire")
    inside = ["-n", name]
    # The second address stays when the first is deleted.
    ip("netns", "exec", name, "sysctl", "-qw", "net.ipv4.conf.all.promote_secondaries=1")
    for address in (host, host + 100):
        ip(*inside, "address", "add", f"10.99.0.{address}/24", "dev", "wire")
    ip(*inside, "link", "set", "wire", "up")
    ip(*inside, "link", "set", "lo", "up")
    return tun


class Rates:
    """The rates of the machines' links to the hub, and when each is free again."""

    def __init__(self) -> None:
        self.bytes_s: dict[int, float] = {}
        self._free: dict[tuple[int, str], float] = {}

    def after(self, at: float, machine: int, way: str, length: int) -> float | None:
        """When the link has carried a packet that reaches it at a time; `None` if its queue is full."""
        rate = self.bytes_s.get(machine, 0.0)
        if rate == 0.0:
            return at
        begins = max(at, self._free.get((machine, way), 0.0))
        if (begins - at) * rate + length > QUEUE_BYTES:
            return None
        self._free[machine, way] = begins + length / rate
        return self._free[machine, way]


def main() -> None:
    hosts = {name: int(host) for name, host in (argument.split(":") for argument in sys.argv[1:])}
    seeded = random.Random(16)
    links: dict[frozenset[int], tuple[float, float]] = {}
    rates = Rates()
    waiting: list[tuple[float, int, int, bytes]] = []
    passed, begun = 0, ""
    try:
        tuns = {host: machine(name, host) for name, host in hosts.items()}
        ready = selectors.DefaultSelector()
        for host, tun in tuns.items():
            ready.register(tun, selectors.EVENT_READ, host)
        ready.register(sys.stdin, selectors.EVENT_READ)
        print("ready", flush=True)
        while True:
            left = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
            for key, _ in ready.select(left):
                if key.data is None:
                    # Not by readline, which would keep a second line where `select` does not see it.
                    text = os.read(sys.stdin.fileno(), 4096).decode()
                    if not text:
                        return
                    *lines, begun = (begun + text).split("\n")
                    for words in map(str.split, lines):
                        if len(words) == 2:
                            rates.bytes_s[hosts[words[0]]] = float(words[1]) * 1e3 / 8
                            continue
                        first, second, delay_ms, loss = words
                        links[frozenset((hosts[first], hosts[second]))] = float(delay_ms) / 1e3, float(loss)
                    continue
                try:
                    packet = os.read(key.fd, 65536)
                except BlockingIOError:
                    continue
                # IPv4: the last byte of the destination, less what a moved machine adds.
                to = packet[19] % 100
                if packet[0] >> 4 != 4 or to not in tuns:
                    continue
                delay_s, loss = links.get(frozenset((key.data, to)), (0.0, 0.0))
                if seeded.random() >= loss:
                    at = rates.after(time.monotonic(), key.data, "sends", len(packet))
                    at = at and rates.after(at + delay_s, to, "receives", len(packet))
                    if at is not None:
                        passed += 1
                        heapq.heappush(waiting, (at, passed, to, packet))
            now = time.monotonic()
            while waiting and waiting[0][0] <= now:
                _, _, to, packet = heapq.heappop(waiting)
                try:
                    os.write(tuns[to], packet)
                except OSError:
                    pass  # The queue of the interface is full: a link drops what it cannot carry.
    finally:
        for name in hosts:
            subprocess.run(["ip", "netns", "delete", name], check=False)


main()
