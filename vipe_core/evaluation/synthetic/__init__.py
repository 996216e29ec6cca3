"""A small ray caster that renders videos with exact poses, intrinsics, depth and masks for every camera model."""

from vipe_core.evaluation.synthetic.clip import (
    CLIP_KINDS,
    ClipKind,
    SyntheticClip,
    render_clip,
    render_rig,
    sample_camera,
    tiny_clip,
)
from vipe_core.evaluation.synthetic.render import RenderedFrame, render_frames
from vipe_core.evaluation.synthetic.scene import Light, Material, Motion, Primitive, Scene, box, room, sphere
from vipe_core.evaluation.synthetic.scenes import courtyard_scene, moving_ball_scene, room_scene

__all__ = [
    "CLIP_KINDS",
    "ClipKind",
    "Light",
    "Material",
    "Motion",
    "Primitive",
    "RenderedFrame",
    "Scene",
    "SyntheticClip",
    "box",
    "courtyard_scene",
    "moving_ball_scene",
    "render_clip",
    "render_frames",
    "render_rig",
    "room",
    "room_scene",
    "sample_camera",
    "sphere",
    "tiny_clip",
]
