"""Packs finished comparisons as docs/results keeps them: a table of means for each, and all their cells in one archive.

    python docs/tools/results.py ARCHIVE COMPARISON ...

takes the archive's name, without its ending, and folders of ``coliags compare``. The same folders give the same bytes.
Cells without a result are left out, and results that are in no cell.
"""

from __future__ import annotations

import csv
import io
import json
import lzma
import sys
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from coliags_plugin.results.reading import find_results
from coliags_plugin.results.record import Result

FOLDER = Path(__file__).parents[1] / "results"
#: Columns of a table in front of the metrics, and behind them.
RUN = ("scene", "method", "split", "seed", "protocol", "set", "frames")
COST = ("gaussians", "processor_seconds", "peak_memory_mib", "key")


def main(name: str, comparisons: Sequence[Path]) -> None:
    """Write a table for each comparison, and the archive of all."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for folder in sorted(comparisons, key=lambda path: path.name):
            plan = finished(folder)
            results = find_results(sorted(folder / cell["result"] for cell in plan["cells"]))
            (FOLDER / f"{folder.name}.csv").write_text(table(results), encoding="utf-8")
            for file, content in files(folder, plan):
                member = tarfile.TarInfo(f"{folder.name}/{file}")
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
    content = lzma.compress(packed.getvalue(), preset=9 | lzma.PRESET_EXTREME)
    (FOLDER / f"{name}.tar.xz").write_bytes(content)


def table(results: Sequence[Result]) -> str:
    """CSV with a row for each run, protocol and test set: means over frames, empty where no frame has the metric."""
    metrics = list(dict.fromkeys(name for result in results for name in result.metrics))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*RUN, *metrics, *COST])
    for result in sorted(results, key=lambda of: (of.scene.name, of.method, of.seed, of.protocol.name)):
        run = (result.scene.name, result.method, result.scene.split, result.seed, result.protocol.name)
        for name, part in result.sets.items():
            means = [part.mean(metric) for metric in metrics]
            cost = [result.cost.gaussians, result.cost.processor_seconds, result.cost.peak_memory_mib]
            numbers = ["" if value is None else f"{value:.6g}" for value in (*means, *cost)]
            writer.writerow([*run, name, len(part.frames), *numbers, result.key])
    return text.getvalue()


def finished(folder: Path) -> dict[str, Any]:
    """The plan of a comparison with the cells that have a result."""
    plan: dict[str, Any] = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    plan["cells"] = [cell for cell in plan["cells"] if (folder / cell["result"]).is_file()]
    return plan


def files(folder: Path, plan: Mapping[str, Any]) -> Iterator[tuple[str, bytes]]:
    """The files of a comparison in the archive, names and contents: its plan, and the results of the plan's cells."""
    yield "plan.json", (json.dumps(plan, indent=2) + "\n").encode()
    for name in sorted(cell["result"] for cell in plan["cells"]):
        yield name, (folder / name).read_bytes()


if __name__ == "__main__":
    main(sys.argv[1], [Path(argument) for argument in sys.argv[2:]])
