"""Smoothness of the rendered depth."""

from coliags_plugin.contracts import Loss, LossSettings
from coliags_plugin.core.tensors import masked_mean


class SmoothDepthLoss(Loss):
    """Mean difference of the expected depth of neighbours, both of them valid, scene units."""

    Settings = LossSettings
    whole_image = True
    wants = frozenset({"depth_expected"})

    def __call__(self, step):
        """The unweighted term."""
        depth, valid = step.output["depth_expected"], step.target.valid
        down = masked_mean(depth.diff(dim=0).abs(), valid[1:] & valid[:-1])
        return down + masked_mean(depth.diff(dim=1).abs(), valid[:, 1:] & valid[:, :-1])
