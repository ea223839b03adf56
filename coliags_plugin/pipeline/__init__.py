"""From a video to mesh, coverage and report, in resumable stages."""
