"""View of each object: its distance, motion on the screen, and focus (section 4.1 of the paper)."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class ViewArrays:
    """Camera, and the view of each object."""

    window: wp.int32  # frames of which `motion` is the sum
    object_model: wp.array(dtype=wp.int32)  # [object] model
    centre: wp.array(dtype=wp.vec3d)  # [model] middle, model frame [model units]
    camera: wp.array(dtype=wp.float64)  # [15] eye [world units]; rows right, up, back; focal length, W [pixels]; D
    frame: wp.array(dtype=wp.int32)  # [object] frames measured: an entry each, so that no launch need count them
    screen: wp.array(dtype=wp.vec3d)  # [object] x, y on the screen a frame ago [pixels], 1 if in front of the camera
    path: wp.array(dtype=wp.float64)  # [slot * objects + object] motion in each frame of the window [pixels]
    distance: wp.array(dtype=wp.float64)  # [object] alpha [world units]
    motion: wp.array(dtype=wp.float64)  # [object] gamma [pixels]
    focus: wp.array(dtype=wp.float64)  # [object] f, 0 to 1


@wp.func
def project_point(camera: wp.array(dtype=wp.float64), p: wp.vec3d):
    """Return x and y on the screen [pixels], and 1 if the point is in front of the camera, else 0."""
    d = wp.vec3d(p[0] - camera[0], p[1] - camera[1], p[2] - camera[2])
    x = (camera[3] * d[0] + camera[4] * d[1]) + camera[5] * d[2]
    y = (camera[6] * d[0] + camera[7] * d[1]) + camera[8] * d[2]
    depth = -((camera[9] * d[0] + camera[10] * d[1]) + camera[11] * d[2])
    if not depth > camera[14] * wp.float64(1.0e-6):
        return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    return wp.vec3d(camera[12] * x / depth, camera[12] * y / depth, wp.float64(1.0))


@wp.func
def measure_view(i: wp.int32, rotation: wp.mat33d, position: wp.vec3d, view: ViewArrays):
    """Measure alpha, gamma and f of an object."""
    n = view.object_model.shape[0]
    camera = view.camera
    p = rotation * view.centre[view.object_model[i]] + position
    distance = wp.length(wp.vec3d(p[0] - camera[0], p[1] - camera[1], p[2] - camera[2]))
    place = project_point(camera, p)
    before = view.screen[i]
    moved = wp.float64(0.0)
    if place[2] > wp.float64(0.0) and before[2] > wp.float64(0.0):
        moved = wp.length(place - before)
    view.screen[i] = place
    view.path[(view.frame[i] % view.window) * n + i] = moved
    view.frame[i] = view.frame[i] + 1
    motion = wp.float64(0.0)
    for slot in range(view.window):
        motion += view.path[slot * n + i]
    view.distance[i] = distance
    view.motion[i] = motion
    wide = camera[13]
    far = camera[14]
    f = wp.min((far - distance) / far, (wide - motion) / wide)
    view.focus[i] = wp.clamp(f, wp.float64(0.0), wp.float64(1.0))


@wp.kernel
def measure_view_kernel(
    rotation: wp.array(dtype=wp.mat33d), position: wp.array(dtype=wp.vec3d), view_inout: ViewArrays
):
    """Measure the view of every object."""
    i = wp.tid()
    measure_view(i, rotation[i], position[i], view_inout)
