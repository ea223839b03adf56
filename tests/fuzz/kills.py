"""Kill every command that writes, and fail each of its writes: ``python -m tests.fuzz.kills --kills 200``.

A kill comes at a random moment, or a random time after a scratch file or folder has appeared. What is then at its final
place must be exactly as before or whole as it is to be; the same command, repeated, must end well and leave no scratch.
With ``--faults``, the disk fills up at one write instead: at the first, the second, and so on; a command must then fail
with a message, or have written everything. With ``--permissions``, it runs under two umasks.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from random import Random

from tests.faults import fault, no_space
from tests.fuzz.writers import (
    TRACEBACK,
    WRITERS,
    command,
    contents,
    in_child,
    is_whole,
    judge,
    make_inputs,
    mark_old,
    scratch,
    start,
    warm_up,
)

#: Exit status of a faulty command that wrote less often than was asked for.
_UNTOUCHED = 77


@dataclass
class Found:
    """What was seen of one command: how often each verdict, and what is wrong."""

    verdicts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


class Bench:
    """One command with its undisturbed result.

    Args:
        name: Of the command.
        folder: To work in.
        inputs: What the commands read.
    """

    def __init__(self, name: str, folder: Path, inputs: Path) -> None:
        self.name, self.writer, self.inputs = name, WRITERS[name], inputs
        self.place, self.log = folder / "place", folder / "log.txt"
        self.reference = folder / "reference"
        folder.mkdir(parents=True, exist_ok=True)
        self._empty()
        self._run(False)  # compiles what is compiled
        self._empty()
        began = time.monotonic()
        self._run(False)
        self.duration = time.monotonic() - began
        shutil.copytree(self.place, self.reference)
        self.new = contents(self.place / self.writer.within)

    def _empty(self) -> None:
        shutil.rmtree(self.place, ignore_errors=True)
        self.place.mkdir(parents=True)
        if self.writer.prepare is not None:
            self.writer.prepare(self.inputs, self.place)

    def _words(self, repeated: bool) -> list[str]:
        return self.writer.words(self.inputs, self.place, repeated)

    def _run(self, repeated: bool) -> None:
        status = in_child(lambda: command(self._words(repeated)), self.log)
        if status != 0:
            raise RuntimeError(f"{self.name} ended with {status}: {self.log.read_text()[-2000:]}")

    def _old(self) -> dict[str, bytes]:
        """Put an older result in place, unless the command goes on with what there is."""
        self._empty()
        if self.writer.goes_on:
            return {}
        shutil.rmtree(self.place)
        shutil.copytree(self.reference, self.place)
        return mark_old(self.place / self.writer.within)

    def kill(self, random: Random, found: Found) -> None:
        """Kill the command, up to three times where it goes on, look, and repeat it."""
        while True:
            old = self._old()
            if self._killed(bool(old), random):
                break
        self._look(old, found)
        more = random.choice((0, 0, 1, 2)) if self.writer.goes_on else 0
        while more and self._killed(bool(contents(self.place / self.writer.within)), random):
            self._look(old, found)
            more -= 1
        self._repeat(found)

    def _killed(self, repeated: bool, random: Random) -> bool:
        """Begin the command and kill it; False where it ended before."""
        pid = start(partial(command, self._words(repeated)), self.log)
        return _killed(pid, self.place, self.duration, random)

    def _look(self, old: dict[str, bytes], found: Found) -> None:
        now = contents(self.place / self.writer.within)
        if self.writer.goes_on:
            # Logs and databases grow; everything else appears whole.
            broken = [
                name
                for name, data in now.items()
                if name in self.new
                and not name.endswith((".jsonl", ".log", ".db"))
                and not is_whole(name, data, self.new[name])
            ]
            verdict = f"broken {broken[:3]}" if broken else "part"
        else:
            verdict = judge(now, old, self.new)
        found.verdicts[verdict if verdict in ("old", "new", "old and new", "part") else "wrong"] += 1
        if verdict not in ("old", "new", "old and new", "part"):
            found.wrong.append(verdict)

    def _repeat(self, found: Found) -> None:
        within = self.place / self.writer.within
        repeated = bool(contents(within))
        status = in_child(lambda: command(self._words(repeated)), self.log)
        if status != 0:
            found.wrong.append(f"repeated, it ended with {status}: {self.log.read_text()[-300:]}")
            return
        verdict = judge(contents(within), {}, self.new)
        if verdict != "new":
            found.wrong.append(f"repeated, {verdict}")
        if left := scratch(self.place):
            found.wrong.append(f"repeated, it left {left}")

    def permissions(self, found: Found) -> None:
        """Run it under two umasks; everything that it makes must have the permissions that these leave."""
        for mask in (0o077, 0o002):
            self._empty()
            given, words = set(self.place.rglob("*")), self._words(False)

            def work(mask: int = mask, words: list[str] = words) -> int:
                os.umask(mask)
                return command(words)

            status = in_child(work, self.log)
            wrong = [f"ended with {status}"] if status != 0 else []
            for path in set((self.place / self.writer.within).rglob("*")) - given:
                made, expected = path.stat().st_mode & 0o777, (0o777 if path.is_dir() else 0o666) & ~mask
                if made != expected:
                    wrong.append(f"{path.relative_to(self.place)} has {made:o}, not {expected:o}")
            found.verdicts["wrong" if wrong else "right"] += 1
            found.wrong += [f"umask {mask:03o}: {text}" for text in wrong[:5]]

    def fail(self, when: int, found: Found) -> bool:
        """Fill the disk at one write; whether there were so many."""
        old = self._old()

        def work() -> int:
            with fault(when, no_space) as faulty:
                status = command(self._words(bool(old)))
            return status if faulty.has_struck else _UNTOUCHED

        status = in_child(work, self.log)
        if status == _UNTOUCHED:
            return False
        if status == 0:
            verdict = judge(contents(self.place / self.writer.within), {}, self.new)
            found.verdicts["done" if verdict == "new" else "wrong"] += 1
            if verdict != "new":
                found.wrong.append(f"write {when}: exit status {status}, but {verdict}")
        elif status == TRACEBACK or status < 0 or "space" not in self.log.read_text():
            found.verdicts["wrong"] += 1
            found.wrong.append(f"write {when}: {status}: {self.log.read_text()[-400:]}")
        else:
            self._look(old, found)
            if left := scratch(self.place):
                found.wrong.append(f"write {when}: left {left}")
        return True


def _killed(pid: int, place: Path, duration: float, random: Random) -> bool:
    """Wait for a moment and kill; False where the process ended before."""
    by_scratch, until = random.random() < 0.5, time.monotonic() + random.uniform(0.0, duration)
    after, left = random.choice((0.0, 0.002, 0.01, 0.05)), set(scratch(place))
    while True:
        if os.waitpid(pid, os.WNOHANG)[0]:
            return False
        if set(scratch(place)) - left if by_scratch else time.monotonic() > until:
            time.sleep(after if by_scratch else 0.0)
            if os.waitpid(pid, os.WNOHANG)[0]:
                return False
            try:
                os.killpg(pid, signal.SIGKILL)
            except ProcessLookupError:  # just forked, it has no group of its own yet
                os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return True
        time.sleep(0.0005)


def table(found: dict[str, Found], verdicts: tuple[str, ...]) -> str:
    """Markdown: a row per command and one of sums."""
    rows = [(name, one.verdicts) for name, one in found.items()]
    rows.append(("**all**", sum((counter for _, counter in rows), Counter())))
    lines = [f"| command | times | {' | '.join(verdicts)} |", "|---" * (len(verdicts) + 2) + "|"]
    lines += [
        f"| {name} | {sum(counter.values())} | {' | '.join(str(counter[verdict]) for verdict in verdicts)} |"
        for name, counter in rows
    ]
    return "\n".join(lines)


def main() -> None:
    """Do it and print a table; status 1 where something was lost or left."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=0, help="kills over all commands")
    parser.add_argument("--faults", type=int, default=0, help="failed writes of each command, at most; 0: none")
    parser.add_argument("--permissions", action="store_true", help="run each under two umasks")
    parser.add_argument("--commands", nargs="*", default=[], metavar="NAME", help="only these")
    parser.add_argument("--inputs", type=Path, help="folder to keep the inputs in, for the next time")
    parser.add_argument("--seed", type=int, default=0, help="of moments")
    options = parser.parse_args()
    names = options.commands or list(WRITERS)
    warm_up()
    kills, faults, umasks = dict[str, Found](), dict[str, Found](), dict[str, Found]()
    with tempfile.TemporaryDirectory() as folder:
        inputs = options.inputs or Path(folder) / "inputs"
        if not inputs.is_dir():
            status = in_child(lambda: _made(inputs), Path(folder) / "log.txt")
            if status:
                raise RuntimeError((Path(folder) / "log.txt").read_text()[-2000:])
        for index, name in enumerate(names):
            bench = Bench(name, Path(folder) / f"{index}", inputs)
            share = (options.kills * (index + 1)) // len(names) - (options.kills * index) // len(names)
            for number in range(share):
                bench.kill(Random(f"{options.seed} {name} {number}"), kills.setdefault(name, Found()))
            for when in range(options.faults):
                if not bench.fail(when, faults.setdefault(name, Found())):
                    break
            if options.permissions:
                bench.permissions(umasks.setdefault(name, Found()))
            shutil.rmtree(Path(folder) / f"{index}")
            told = [one for group in (kills, faults, umasks) if (one := group.get(name)) is not None]
            print(name, [dict(one.verdicts) for one in told], [one.wrong for one in told], file=sys.stderr, flush=True)
    for title, group, verdicts in (
        ("Kills", kills, ("old", "new", "old and new", "part", "wrong")),
        ("Failed writes", faults, ("old", "new", "old and new", "part", "done", "wrong")),
        ("Permissions", umasks, ("right", "wrong")),
    ):
        if group:
            print(f"{title}\n\n{table(group, verdicts)}\n")
    wrong = {name: one.wrong for group in (kills, faults, umasks) for name, one in group.items() if one.wrong}
    for name, messages in wrong.items():
        print(name, *messages, sep="\n  ")
    sys.exit(1 if wrong else 0)


def _made(inputs: Path) -> int:
    make_inputs(inputs)
    return 0


if __name__ == "__main__":
    main()
