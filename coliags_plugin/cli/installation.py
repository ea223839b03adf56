"""Commands on the installation: ``coliags doctor``, ``coliags weights``."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli.summaries import print_summary
from coliags_plugin.config import options


@dataclass(frozen=True)
class DoctorCommand:
    """Report versions and devices, which renderer would be used and why, and where the weights of LPIPS are.

    On a CUDA device the renderers are tried: their errors on small views, and frames per second.
    """

    device: Annotated[str, tyro.conf.arg(metavar="auto|cpu|cuda|cuda:N")] = "auto"
    """Device whose renderers are tried; auto: the first CUDA device, or none."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print the results; exit with status 1 where a requirement is missing or a renderer is wrong."""
        from coliags_plugin.checks.installation import check_installation
        from coliags_plugin.reporting.model import Fact, FactList
        from coliags_plugin.reporting.text_formats import terminal_text

        results = check_installation(self.device)
        marks = {"passed": "ok ", "failed": "BAD", "skipped": "-  "}
        facts = [Fact(f"{marks[each.status]} {each.name}", each.detail) for each in results]
        text = terminal_text([FactList(facts)])
        print_summary(text, {"checks": [asdict(each) for each in results]}, as_json=self.json)
        if any(each.status == "failed" for each in results):
            sys.exit(1)


@dataclass(frozen=True)
class WeightsCommand:
    """Download the weights that LPIPS needs, or copy them; nothing else in this package downloads."""

    metric: tyro.conf.Positional[Literal["lpips"]]
    """Whose weights."""
    net: Literal["vgg", "alex", "squeeze", "all"] | None = None
    """Backbone: VGG's has 528 MiB, AlexNet's 233, SqueezeNet's 5; default: vgg and squeeze, for the protocol paper."""
    folder: options.OptionalPath = None
    """Where to install them; default: torch's download cache, where LPIPS finds them."""
    from_folder: Annotated[options.OptionalPath, tyro.conf.arg(name="from")] = None
    """Copy the files from this folder instead of downloading them."""

    def run(self) -> None:
        """Install what is missing, and print where the weights of each net are."""
        from coliags_plugin.metrics.lpips_install import SOURCES, install
        from coliags_plugin.metrics.lpips_weights import DEFAULT_NETS, WEIGHTS_VARIABLE, find_weights, search

        nets = DEFAULT_NETS if self.net is None else tuple(SOURCES) if self.net == "all" else (self.net,)
        folder = None if self.folder is None else self.folder.expanduser().resolve()
        written = install(nets, folder, self.from_folder)
        for net in nets:
            backbone, heads = find_weights(net, folder)
            print(f"LPIPS {net}: backbone {backbone}, linear heads {heads}")
        if not written:
            print("Everything was there already.")
        if folder is not None and any(search(net) != find_weights(net, folder) for net in nets):
            print(f"Set {WEIGHTS_VARIABLE}={folder} for LPIPS to find them.")
