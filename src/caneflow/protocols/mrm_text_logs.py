"""Logs of a P440 as the vendor's program writes them: a line of text per scan, among lines of other kinds."""

import codecs
from collections.abc import Iterable

import numpy as np

from caneflow.protocols.errors import ProtocolError
from caneflow.protocols.mrm import LONGEST_SCAN, RadarConfig, ScanInfo
from caneflow.protocols.mrm_salvage import Damage, Log, assembled
from caneflow.protocols.mrm_scans import Scan, split_scan

SCAN_LINE, CONFIG_LINE = "MrmFullScanInfo", "Config"
COLUMNS = (  # of a SCAN_LINE where no line names them
    "Timestamp, MrmFullScanInfo, MessageId, SourceId, EmbeddedTimestamp, Reserved, Reserved, Reserved, Reserved, "
    "ScanStartPs, ScanStopPs, ScanStepBins, Filtering, AntennaId, Reserved, NumSamplesTotal, ScanData"
)
FIRST_SAMPLES = "ScanData"  # the column where they begin
SEPARATORS = ",;\t"
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def is_text(data: bytes) -> bool:
    """Whether the vendor's lines stand there rather than packets."""
    if data.startswith(UTF_16):
        return True
    control = any(byte < 9 or 13 < byte < 32 for byte in data[:4096])
    return SCAN_LINE.encode() in data or (b"Mrm" in data[:65536] and not control)


def parse_text_log(data: bytes) -> Log:
    """The log in `data`, in UTF-8 or UTF-16; damaged lines are left out and named.

    Raises:
        ProtocolError: it holds no scan; it names the first thing that is wrong.
    """
    scans: list[Scan] = []
    damage: list[Damage] = []
    columns = _columns(_cells(COLUMNS))
    config: RadarConfig | None = None
    for number, line in enumerate(_decoded(data).split("\n"), 1):
        if SCAN_LINE not in line and CONFIG_LINE not in line:
            continue
        cells = _cells(line)
        if FIRST_SAMPLES in cells:
            columns = _columns(cells)
        elif SCAN_LINE in line:
            try:
                scans.append(_scan_of(cells, columns))
            except (ValueError, KeyError, IndexError, OverflowError) as error:
                size, lost = len(line) + 1, float(line.count(SCAN_LINE))
                damage.append(Damage(place=f"line {number}", size=size, reason=str(error), scans=lost))
        elif config is None:
            config = _config_of(cells)
    if not scans:
        reason = f"{damage[0].place}: {damage[0].reason}" if damage else f"no line with {SCAN_LINE}"
        raise ProtocolError(f"log, {reason}")
    whole, counts = assembled(_packets(scans))
    return Log(config=config, scans=whole, counts=counts, bytes_left=0, damage=tuple(damage))


def _decoded(data: bytes) -> str:
    """The text with a line feed at the end of each line."""
    text = data.decode("utf-16" if data.startswith(UTF_16) else "utf-8-sig", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _cells(line: str) -> list[str]:
    separator = max(SEPARATORS, key=line.count)
    return [cell.strip().strip('"').strip() for cell in line.split(separator)]


def _columns(cells: list[str]) -> dict[str, int]:
    """Where the cells of a scan's line are, by name."""
    return {cell: index for index, cell in reversed(list(enumerate(cells)))}


def _scan_of(cells: list[str], columns: dict[str, int]) -> Scan:
    """The scan of a line; raises ValueError and others for a damaged one."""

    def value(name: str, lowest: int, highest: int) -> int:
        found = int(cells[columns[name]])
        if not lowest <= found <= highest:
            raise ValueError(f"{name} is {found}; expected {lowest} to {highest}")
        return found

    total = value("NumSamplesTotal", 1, LONGEST_SCAN)
    samples = [cell for cell in cells[columns[FIRST_SAMPLES] :] if cell]
    if len(samples) != total:
        raise ValueError(f"{len(samples)} samples of {total}")
    return Scan(
        source_id=value("SourceId", 0, 2**32 - 1),
        message_id=value("MessageId", 0, 2**32 - 1) % 2**16,
        timestamp_ms=value("EmbeddedTimestamp", 0, 2**32 - 1),
        scan_start_ps=value("ScanStartPs", -(2**31), 2**31 - 1),
        scan_stop_ps=value("ScanStopPs", -(2**31), 2**31 - 1),
        scan_step_bins=value("ScanStepBins", 1, 2**16 - 1),
        scan_type=value("Filtering", 0, 255),
        antenna_id=value("AntennaId", 0, 255),
        operation_mode=1,
        samples=np.array([int(cell) for cell in samples], dtype=np.int32),
    )


def _config_of(cells: list[str]) -> RadarConfig | None:
    """Node, window and integration of a `Config` line; None where it is not made of numbers."""
    try:
        node, start, stop, resolution, index = (int(cell) for cell in cells[2:7])
        return RadarConfig(
            node_id=node,
            scan_start_ps=start,
            scan_stop_ps=stop,
            scan_resolution_bins=resolution,
            base_integration_index=index,
        )
    except (ValueError, TypeError):
        return None


def _packets(scans: Iterable[Scan]) -> Iterable[ScanInfo]:
    for scan in scans:
        yield from split_scan(scan)
