"""On what a recording was computed. The same platform gives the same bytes; how another one differs is named."""

import os
import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Self

import msgspec

from caneflow import dispatch

LONGEST_WORD = 100  # characters of a name or version that is believed
KERNELS = ("numpy", "blas", "mathematics")  # what can be pinned: see caneflow.dispatch


class Platform(msgspec.Struct, frozen=True, kw_only=True):
    """Everything beside the program that decides the last digits of a result."""

    machine: str  # the processor's architecture, e.g. x86_64
    python: str
    libc: str  # with its version; "" when it does not say
    numpy: str
    scipy: str
    pinned: tuple[str, ...]  # of KERNELS

    @classmethod
    def here(cls) -> Self:
        """That of this process, as it is now."""
        return cls(
            machine=os.uname().machine,
            python=platform.python_version(),
            libc=dispatch.glibc(),
            numpy=version("numpy"),
            scipy=version("scipy"),
            pinned=dispatch.pinned(),
        )

    @classmethod
    def read(cls, metadata: Mapping[str, str]) -> Self | None:
        """That of a recording with this `metadata`; None when it does not say, or in a way unknown here."""
        try:
            found = msgspec.json.decode(metadata["platform"], type=cls)
        except (KeyError, msgspec.DecodeError):
            return None
        words = (found.machine, found.python, found.libc, found.numpy, found.scipy, *found.pinned)
        return found if all(word.isprintable() and len(word) <= LONGEST_WORD for word in words) else None

    def as_json(self) -> str:
        """As it stands in a recording's metadata."""
        return msgspec.json.encode(self).decode()

    def differences(self, other: "Platform") -> list[str]:
        """What may give `other` other digits than this one, as "numpy 2.4.6, here 2.5.0"; none: the same bytes."""
        names = ("machine", "python", "libc", "numpy", "scipy")
        pairs = [(name, getattr(self, name) or "unknown", getattr(other, name) or "unknown") for name in names]
        different = [f"{name} {then}, here {now}" for name, then, now in pairs if then != now]
        for part in KERNELS:
            if part not in self.pinned:
                different.append(f"kernels of {part} not pinned there")
            if part not in other.pinned:
                different.append(f"kernels of {part} not pinned here")
        return different

    def __str__(self) -> str:
        free = [part for part in KERNELS if part not in self.pinned]
        held = f"not pinned: {', '.join(free)}" if free else "pinned"
        words = (self.machine, f"Python {self.python}", self.libc, f"numpy {self.numpy}", f"scipy {self.scipy}", held)
        return ", ".join(filter(None, words))
