"""``coliags doctor``: report versions, devices, the renderer in use and the weights of LPIPS."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass

from coliags_plugin.cli.arguments import AsJson
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class DoctorCommand:
    """Report versions and devices, which renderer would be used and why, and where the weights of LPIPS are."""

    json: AsJson = False

    def run(self) -> None:
        """Print the results; exit with status 1 where a requirement is missing."""
        from coliags_plugin.checks.installation import check_installation

        results = check_installation()
        lines = [f"{'BAD' if each.status == 'failed' else 'ok '} {each.name:<34} {each.detail}" for each in results]
        print_summary("\n".join(lines), {"checks": [asdict(each) for each in results]}, as_json=self.json)
        if any(each.status == "failed" for each in results):
            sys.exit(1)
