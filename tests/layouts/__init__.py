"""Layouts of public datasets, in which phantoms are written here so that their readers have something to read."""

from coliags_plugin.config.registry import phantom_layouts

for name, target in {
    "c3vd-raw": "c3vd:C3VDRawLayout",
    "c3vd-v2": "c3vd:C3VDv2Layout",
    "endogslam": "endogslam:EndoGSLAMLayout",
    "endomapper": "endomapper:EndoMapperLayout",
    "pr-endo": "endogslam:PREndoLayout",
    "reim-nerf": "reim_nerf:ReimNerfLayout",
    "rotatecolon": "rotatecolon:RotateColonLayout",
}.items():
    phantom_layouts.register(name, f"tests.layouts.{target}", source="tests")
