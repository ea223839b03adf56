"""``coliags doctor``: what this machine has, and what would be used."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doctor:
    """Say which versions and devices are here, and which renderer would be used and why."""

    def run(self) -> None:
        """Print the findings; exit with status 1 where something needed is missing."""
        import sys

        from coliags_plugin.engine.doctor import examine

        findings = examine()
        for finding in findings:
            print(f"{'ok ' if finding.ok else 'BAD'} {finding.subject:<34} {finding.text}")
        if not all(finding.ok for finding in findings):
            sys.exit(1)
