"""``coliags view``: fly through a run in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import OptionalPath


@dataclass(frozen=True)
class View:
    """Show a run in a browser: Gaussians, cameras, meshes, recorded and rendered pictures. Needs the extra `viewer`."""

    path: tyro.conf.Positional[Path]
    """Run folder."""
    host: str = "127.0.0.1"
    """Name or address to listen on; 0.0.0.0: all of this machine, for anyone who can reach it. From another machine,
    better: ssh -L 8080:localhost:8080 THIS_MACHINE, and open http://localhost:8080 there."""
    port: int = 8080
    """Port to listen on; 0: any free one."""
    open: bool = True
    """Open a browser, where there is a display."""
    save: OptionalPath = None
    """Write the scene as a self-contained page of at most 5 MB instead, which opens offline."""
    data: OptionalPath = None
    """The scene's folder, where it has moved since training."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""

    def run(self) -> None:
        """Serve the run until Ctrl-C, or write the page and print its path."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        if self.save is not None:
            print(run.save_view(self.save))
            return
        try:
            with run.view(host=self.host, port=self.port) as viewer:
                print(f"{viewer.url} (Ctrl-C ends it)", flush=True)
                if self.open:
                    viewer.open()
                viewer.wait()
        except KeyboardInterrupt:
            print("ended")
