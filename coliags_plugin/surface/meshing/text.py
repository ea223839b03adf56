"""Text of a comparison of surfaces, for the terminal."""

from __future__ import annotations

from coliags_plugin.geometry.meshes.comparison import SurfaceComparison
from coliags_plugin.outputs.text_table import aligned


def comparison_text(compared: SurfaceComparison) -> str:
    """The figures as two tables."""
    directions = {
        "accuracy: mesh to true surface": compared.accuracy,
        "completeness: seen to mesh": compared.completeness,
    }
    distances = [["mm", "mean", "median", "95 %"]]
    distances += [
        [name, f"{d.mean:.3f}", f"{d.median:.3f}", f"{d.percentile_95:.3f}"] for name, d in directions.items()
    ]
    shares = [["within", "precision", "recall", "F"]]
    shares += [
        [f"{score.threshold_mm:g} mm", f"{score.precision:.4f}", f"{score.recall:.4f}", f"{score.f:.4f}"]
        for score in compared.scores
    ]
    facts = [
        f"Chamfer distance (mean of both means) {compared.chamfer:.3f} mm, HD95 {compared.hausdorff_95:.3f} mm, "
        f"normals {compared.normal_error:.1f} degrees off",
        f"seen: {compared.seen_area:.0f} mm^2 ({compared.seen_by}); "
        f"{compared.beyond_seen:.1%} of the mesh lies beyond it",
    ]
    return "\n".join([*aligned(distances), "", *aligned(shares), "", *facts])
