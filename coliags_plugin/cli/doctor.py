"""``coliags doctor``: report versions, devices, the renderer in use and the weights of LPIPS."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doctor:
    """Report versions and devices, which renderer would be used and why, and where the weights of LPIPS are."""

    def run(self) -> None:
        """Print the findings; exit with status 1 where a requirement is missing."""
        import sys

        from coliags_plugin.engine.doctor import examine

        findings = examine()
        for finding in findings:
            print(f"{'ok ' if finding.ok else 'BAD'} {finding.subject:<34} {finding.text}")
        if not all(finding.ok for finding in findings):
            sys.exit(1)
