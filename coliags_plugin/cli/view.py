"""``coliags view``: fly through a run in a browser."""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary


@dataclass(frozen=True)
class ViewCommand:
    """Show a run in a browser: Gaussians, cameras, meshes, recorded and rendered pictures. Needs the extra `viewer`."""

    path: arguments.RunFolder
    output: arguments.OptionalOutput = None
    """Write the scene to this file instead, as a self-contained HTML page of at most 5 MB, which opens offline."""
    host: str = "127.0.0.1"
    """Name or address to listen on; 0.0.0.0: all of this machine, for anyone who can reach it. From another machine,
    better: ssh -L 8080:localhost:8080 THIS_MACHINE, and open http://localhost:8080 there."""
    port: int = 8080
    """Port to listen on; 0: any free one."""
    open: bool = True
    """Open a browser, where there is a display."""
    data: arguments.MovedData = None
    device: arguments.Device = "auto"
    json: arguments.AsJson = False

    def run(self) -> None:
        """Serve the run until Ctrl-C, or write the page."""
        from coliags_plugin.api.runs import load_run

        run = load_run(self.path, data=self.data, device=self.device)
        if self.output is not None:
            print_summary(written=[run.save_view(self.output)], as_json=self.json)
            return
        try:
            with run.view(host=self.host, port=self.port) as viewer:
                print(f"{viewer.url} (Ctrl-C ends it)", flush=True)
                if self.open:
                    viewer.open()
                viewer.wait()
        except KeyboardInterrupt:
            print("ended")
