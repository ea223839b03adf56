"""Smoothness of the rendered depth."""

from kornia.losses import total_variation

from coliags_plugin.contracts import Loss, LossSettings


class SmoothDepthLoss(Loss):
    """Mean total variation of the expected depth, scene units."""

    Settings = LossSettings
    whole_image = True
    wants = frozenset({"depth_expected"})

    def __call__(self, step):
        """The unweighted term."""
        return total_variation(step.output["depth_expected"][None], reduction="mean").mean()
