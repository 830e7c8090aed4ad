"""Distances of object pairs as a PyTorch function of all poses, with a backward pass on the device."""

from contextlib import nullcontext
from functools import cache

import warp as wp

from warp_abtree.interop.tape import PosedDistances, check_query, pose_rows
from warp_abtree.query.stages.distance import DistanceQuery


@cache
def _make_function():
    """Return the autograd function, made when PyTorch is first needed."""
    import torch

    def on_stream(tensor):
        """Launch on PyTorch's stream; Warp's own waits for it."""
        stream = wp.stream_from_torch(tensor.device) if tensor.is_cuda else None
        return nullcontext() if stream is None else wp.ScopedStream(stream, sync_exit=True)

    class PairDistanceFunction(torch.autograd.Function):
        @staticmethod
        def forward(context, poses, query):
            rows = poses.detach().contiguous()
            with on_stream(poses):
                context.posed = PosedDistances(query, pose_rows(rows, query))
            context.save_for_backward(poses)
            return wp.to_torch(context.posed.distance).to(poses.dtype)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(context, weight):
            (poses,) = context.saved_tensors  # raises where they were changed in place
            gradient = torch.zeros_like(poses, memory_format=torch.contiguous_format)
            weight = weight.to(torch.float64).contiguous()
            with on_stream(poses):
                width = 7 if poses.ndim == 2 else 16
                rows = wp.from_torch(gradient.view(-1, width), requires_grad=False)
                context.posed.add_gradient(wp.from_torch(weight, requires_grad=False), rows)
            return gradient, None

    return PairDistanceFunction


def pair_distance(query: DistanceQuery, poses):
    """Return the distances of a query's pairs as a PyTorch function of the poses of all objects.

    Places the objects, where they stay, and launches the query, from the tensor's memory; waits for the device once or
    twice. The backward pass only launches, and gives the same bits at every run; gradients of gradients are refused.

    Args:
        query: `DistanceQuery` that was given its pairs; signed, if depths are to count.
        poses: Tensor on the query's device, float32 or float64: (n, 7) x y z qx qy qz qw, quaternions of any norm but
            0, which are normalised in float64, or (n, 4, 4) rigid matrices.

    Returns:
        Tensor (p,) of the type of poses [world units]. Its gradient by a quaternion is of the normalised one,
        orthogonal to scaling; that by a matrix lies within the rigid motions; the last row has none. Where nearest
        points are not unique, or the distance is 0 or infinite, see `query.stages.distance`.

    Raises:
        TypeError: No `DistanceQuery`, or poses that are no dense tensor.
        ValueError: A query that runs the broad phase, poses of another shape, count, type or device, or one that is no
            pose; no object has moved.
        RuntimeError: A graph is being captured, or as `DistanceQuery.launch`.
    """
    import torch

    check_query(query)
    if not isinstance(poses, torch.Tensor) or poses.layout != torch.strided:
        kind = getattr(poses, "layout", type(poses).__name__)
        raise TypeError(f"poses: a dense torch.Tensor is expected, not a {kind}")
    return _make_function().apply(poses, query)
