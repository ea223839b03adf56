"""``coliags doctor``: report versions, devices, the renderer in use and the weights of LPIPS."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doctor:
    """Report versions and devices, which renderer would be used and why, and where the weights of LPIPS are."""

    def run(self) -> None:
        """Print the results; exit with status 1 where a requirement is missing."""
        import sys

        from coliags_plugin.checks.installation import check_installation

        results = check_installation()
        for result in results:
            print(f"{'ok ' if result.status == 'passed' else 'BAD'} {result.name:<34} {result.detail}")
        if any(result.status == "failed" for result in results):
            sys.exit(1)
