"""Hosts in network namespaces on one computer, with a network between them that has faults.

Every host is a namespace with a TUN device; packets go from device to device through a thread of the test, which
delays, drops and holds them up as it is told. It does what `tc netem` does, with a seed, on kernels without netem.
"""

import fcntl
import heapq
import os
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
LONGEST_QUEUE = 1.0  # s that packets may wait for a slow line; what comes then is dropped


@dataclass
class Faults:
    """What is wrong with the network, from now on."""

    delay: float = 0.0  # s, one way
    jitter: float = 0.0  # s, at most this much more or less, each packet for itself
    loss: float = 0.0  # of all packets
    rate: float = 0.0  # bit/s in each direction; 0: as fast as it goes
    cut: bool = False  # nothing gets through


@dataclass
class Network:
    """Hosts by name, each with an address of its own."""

    names: Sequence[str]
    faults: Faults = field(default_factory=Faults)
    carried: int = 0  # packets
    dropped: int = 0  # packets

    def __post_init__(self) -> None:
        self.addresses = {name: f"10.77.0.{i + 1}" for i, name in enumerate(self.names)}

    def address(self, name: str) -> str:
        return self.addresses[name]

    def change_address(self, name: str, address: str) -> None:
        """Give the host another address; its connections are dead and nobody is told."""
        device = self._device(name)
        self._ip("-n", self.namespace(name), "address", "del", f"{self.address(name)}/24", "dev", device)
        self._ip("-n", self.namespace(name), "address", "add", f"{address}/24", "dev", device)
        self.addresses[name] = address

    def command(self, name: str, *args: str) -> list[str]:
        """`args` as it is run on the host `name`."""
        return ["ip", "netns", "exec", self.namespace(name), *args]

    @contextmanager
    def up(self) -> Iterator["Network"]:
        """The hosts and their network; raises OSError or CalledProcessError where that is not permitted."""
        devices: list[int] = []
        stop = threading.Event()
        thread = threading.Thread(target=self._carry, args=(devices, stop))
        try:
            for name in self.names:
                devices.append(self._host(name))
            thread.start()
            yield self
        finally:
            stop.set()
            if thread.is_alive():
                thread.join()
            for device in devices:
                os.close(device)
            for name in self.names:
                subprocess.run(["ip", "netns", "del", self.namespace(name)], capture_output=True, check=False)

    def namespace(self, name: str) -> str:
        return f"caneflow-{os.getpid()}-{name}"

    def _device(self, name: str) -> str:
        return f"cf{os.getpid() % 100_000}n{self.names.index(name)}"

    def _ip(self, *args: str) -> None:
        subprocess.run(["ip", *args], capture_output=True, check=True)

    def _host(self, name: str) -> int:
        space, tun, ip = self.namespace(name), self._device(name), self._ip
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        try:
            fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH14x", tun.encode(), IFF_TUN | IFF_NO_PI))
            ip("netns", "add", space)
            ip("link", "set", tun, "netns", space)
            ip("-n", space, "link", "set", "lo", "up")
            ip("-n", space, "address", "add", f"{self.address(name)}/24", "dev", tun)
            ip("-n", space, "link", "set", tun, "up")
        except BaseException:
            os.close(device)
            raise
        return device

    def _carry(self, devices: list[int], stop: threading.Event) -> None:
        chance = np.random.default_rng(1)
        on_the_way: list[tuple[float, int, int, bytes]] = []  # due at, order, device, packet
        free_at: dict[tuple[int, int], float] = {}  # from, to: when the line has sent what it has
        order = 0
        while not stop.is_set():
            now = time.monotonic()
            while on_the_way and on_the_way[0][0] <= now:
                _, _, device, packet = heapq.heappop(on_the_way)
                self._deliver(device, packet)
            wait = min(0.05, max(0.0, on_the_way[0][0] - now)) if on_the_way else 0.05
            for source in select.select(devices, [], [], wait)[0]:
                for packet in _packets(source):
                    target = self._target(packet, devices)
                    if target is None:
                        continue
                    due = self._due(free_at, (source, target), len(packet), chance)
                    if due is None:
                        self.dropped += 1
                    else:
                        order += 1
                        heapq.heappush(on_the_way, (due, order, target, packet))

    def _target(self, packet: bytes, devices: list[int]) -> int | None:
        """The device of the host that an IPv4 packet is for."""
        if packet[0] >> 4 != 4:
            return None
        address = ".".join(map(str, packet[16:20]))
        return next(
            (dev for name, dev in zip(self.names, devices, strict=True) if self.addresses[name] == address), None
        )

    def _due(
        self, free_at: dict[tuple[int, int], float], way: tuple[int, int], size: int, chance: np.random.Generator
    ) -> float | None:
        """When a packet arrives; None: never."""
        faults, now = self.faults, time.monotonic()
        if faults.cut or chance.random() < faults.loss:
            return None
        sent = now
        if faults.rate:
            sent = max(now, free_at.get(way, 0.0)) + size * 8 / faults.rate
            if sent - now > LONGEST_QUEUE:
                return None
            free_at[way] = sent
        return sent + faults.delay + chance.uniform(-1, 1) * faults.jitter

    def _deliver(self, device: int, packet: bytes) -> None:
        try:
            os.write(device, packet)
            self.carried += 1
        except OSError:
            self.dropped += 1  # its queue is full


def _packets(device: int) -> Iterator[bytes]:
    while True:
        try:
            yield os.read(device, 65_536)
        except BlockingIOError:
            return
