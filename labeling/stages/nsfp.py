"""Neural scene flow prior: fit a pair of nets to each of a batch of clusters at run time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from labeling.geometry.neighbors import build_tree, residuals_m
from labeling.stages.nets import BatchedAdam, NetBatch, make_nets
from schemas.arrays import Float32Array, Float64Array, Int64Array
from schemas.config import FlowParams
from schemas.errors import InvalidInput

MIN_IMPROVEMENT = 1e-3  # share of the loss; less does not reset a cluster's patience
FAR_AWAY_M = 1.0e4  # where padding is put, either side on its own: never anybody's nearest neighbour
RESIDUAL_CUTOFF_M = 0.5  # a point without a neighbour costs this much when start and fit are compared
MAX_DENSE_PAIRS = 16_000_000  # above, neighbours come from a k-d tree instead of a distance matrix


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """One cluster and what it may have become."""

    clusters: Int64Array  # whose flow this fit decides
    rows: Int64Array  # (P,) rows of the flow that this fit fills
    points: Float32Array  # (P, 3) where the field is evaluated
    fit_rows: Int64Array  # (S,) rows of ``points`` that the fit sees
    target: Float32Array  # (K, 3) what the cluster may have become, K >= 1
    target_rows: Int64Array  # (Q,) rows of ``target`` that the fit sees
    start_m: Float64Array  # (3,) the nets learn what this displacement leaves over
    rng: np.random.Generator


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """The best iterate of one fit."""

    flow_m: Float32Array  # (P, 3)
    num_iterations: int
    final_loss_m2: float  # data term of the kept iterate, mean over terms
    is_finite: bool


def failed_fit(problem: FitProblem) -> FitResult:
    """Return the result of a fit that could not be made."""
    return FitResult(np.zeros(problem.points.shape, dtype=np.float32), 0, np.nan, is_finite=False)


@dataclass(slots=True, eq=False)
class _Padded:
    """Problems as tensors: points are relative to each cluster's mean, invalid entries are masked."""

    source: Tensor  # (B, S, 3)
    target: Tensor  # (B, Q, 3)
    start: Tensor  # (B, 1, 3)
    has_source: Tensor  # (B, S)
    has_target: Tensor  # (B, Q)

    def select(self, rows: Tensor) -> "_Padded":
        return _Padded(
            self.source[rows], self.target[rows], self.start[rows], self.has_source[rows], self.has_target[rows]
        )


def fit_nets(problems: Sequence[FitProblem], params: FlowParams) -> list[FitResult]:
    """Minimise eq. 2 of the paper for each problem by Adam; each stops on its own and leaves the batch.

    Returns:
        One result a problem, in order: the field of the best iterate, evaluated at all points of the cluster.

    Raises:
        InvalidInput: ``params.device`` is not there.

    Source: paper section 3.1, eq. 1 and 2. Chamfer terms are sums of squared distances, both directions, dropped
    beyond ``chamfer_cutoff_m``. The pairwise consistency term equals 2 alpha sum |f - mean|^2: linear, not quadratic.

    """
    device = _open_device(params)
    means = [problem.points[problem.fit_rows].mean(axis=0, dtype=np.float64) for problem in problems]
    data = _pad(problems, means, device)
    is_from_start = params.has("voted_start")
    shape = (params.hidden_layers, params.hidden_units)
    rngs = [problem.rng for problem in problems]
    forward = make_nets(rngs, *shape, device, is_zero_at_start=is_from_start)
    backward = make_nets(rngs, *shape, device, is_zero_at_start=is_from_start) if params.has("backward_net") else None
    best = NetBatch([layer.clone() for layer in forward.layers])

    num_layers = len(forward.layers)
    adam = BatchedAdam([*forward.layers, *(backward.layers if backward else [])], params.learning_rate)
    active = torch.arange(len(problems), device=device)
    best_loss = torch.full((len(problems),), torch.inf, device=device)
    best_data = torch.full((len(problems),), torch.inf, device=device)
    patience_loss = best_loss.clone()
    last_gain = torch.zeros(len(problems), dtype=torch.long, device=device)
    num_iterations = torch.zeros(len(problems), dtype=torch.long, device=device)

    for iteration in range(params.iterations):
        parameters = [parameter.requires_grad_() for parameter in adam.parameters]
        nets = NetBatch(parameters[:num_layers])
        inverse = NetBatch(parameters[num_layers:]) if backward else None
        loss, data_term = _loss(nets, inverse, data, params)
        num_iterations[active] = iteration + 1
        with torch.no_grad():
            is_better = loss < best_loss[active]
            rows = active[is_better]
            best.copy_rows(nets, rows, is_better.nonzero()[:, 0])
            best_loss[rows], best_data[rows] = loss[is_better].detach(), data_term[is_better].detach()
            has_gain = loss < patience_loss[active] * (1 - MIN_IMPROVEMENT)
            patience_loss[active[has_gain]] = loss[has_gain].detach()
            last_gain[active[has_gain]] = iteration
            goes_on = (iteration - last_gain[active] < params.patience) & torch.isfinite(loss)
        if not goes_on.any() or iteration + 1 == params.iterations:
            break
        adam.step(torch.autograd.grad(loss[goes_on].sum(), parameters))
        if not goes_on.all():
            kept = goes_on.nonzero()[:, 0]
            adam.keep(kept)
            data, active = data.select(kept), active[kept]
    return [
        _evaluate(problem, mean, best.select(torch.tensor([k])), num_iterations[k], best_data[k], params)
        for k, (problem, mean) in enumerate(zip(problems, means, strict=True))
    ]


def _open_device(params: FlowParams) -> torch.device:
    if params.device == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("flow.device is cuda, but PyTorch finds no GPU here: expected one, or flow.device=cpu")
    return torch.device(params.device)


def _pad(problems: Sequence[FitProblem], means: list[Float64Array], device: torch.device) -> _Padded:
    num_source = max(len(problem.fit_rows) for problem in problems)
    num_target = max(len(problem.target_rows) for problem in problems)
    source = np.zeros((len(problems), num_source, 3), dtype=np.float32)
    target = np.zeros((len(problems), num_target, 3), dtype=np.float32)
    has_source = np.zeros((len(problems), num_source), dtype=bool)
    has_target = np.zeros((len(problems), num_target), dtype=bool)
    for k, (problem, mean) in enumerate(zip(problems, means, strict=True)):
        source[k, : len(problem.fit_rows)] = problem.points[problem.fit_rows] - mean
        target[k, : len(problem.target_rows)] = problem.target[problem.target_rows] - mean
        has_source[k, : len(problem.fit_rows)], has_target[k, : len(problem.target_rows)] = True, True
    start = np.stack([problem.start_m for problem in problems]).astype(np.float32)[:, None]
    arrays = (source, target, start, has_source, has_target)
    return _Padded(*(torch.from_numpy(array).to(device) for array in arrays))


def _loss(nets: NetBatch, inverse: NetBatch | None, data: _Padded, params: FlowParams) -> tuple[Tensor, Tensor]:
    """Return (B,) total losses and (B,) data terms a point, for reports."""
    flow = data.start + nets(data.source)
    moved = data.source + flow
    data_term = _chamfer(moved, data.target, data.has_source, data.has_target, params.chamfer_cutoff_m)
    if inverse is not None:
        returned = moved - data.start + inverse(moved)
        data_term = data_term + _chamfer(
            returned, data.source, data.has_source, data.has_source, params.chamfer_cutoff_m
        )
    count = data.has_source.sum(dim=1)
    weight = data.has_source[..., None].to(flow.dtype)
    mean = (flow * weight).sum(dim=1, keepdim=True) / count[:, None, None]
    spread = ((flow - mean).square() * weight).sum(dim=(1, 2))
    total = data_term + 2 * params.local_consistency * spread  # eq. 2, last term, over all pairs
    return total, (data_term / count).detach()


def _chamfer(a: Tensor, b: Tensor, has_a: Tensor, has_b: Tensor, cutoff_m: float) -> Tensor:
    """Return (B,) sums of squared distances to the nearest neighbour, both directions."""
    nearest_b, nearest_a = _nearest_rows(a.detach(), b.detach(), has_a, has_b)
    matched_b = b.gather(1, nearest_b[..., None].expand(-1, -1, 3))
    matched_a = a.gather(1, nearest_a[..., None].expand(-1, -1, 3))
    squared_a, squared_b = (a - matched_b).square().sum(dim=2), (b - matched_a).square().sum(dim=2)
    is_near_a, is_near_b = has_a & (squared_a < cutoff_m**2), has_b & (squared_b < cutoff_m**2)
    return (squared_a * is_near_a).sum(dim=1) + (squared_b * is_near_b).sum(dim=1)


def _nearest_rows(a: Tensor, b: Tensor, has_a: Tensor, has_b: Tensor) -> tuple[Tensor, Tensor]:
    """Return (B, S) rows of b nearest to a and (B, Q) rows of a nearest to b, among valid entries."""
    if len(a) == 1 and a.shape[1] * b.shape[1] > MAX_DENSE_PAIRS:
        arrays = a[0].cpu().numpy(), b[0].cpu().numpy()
        found = [cKDTree(arrays[1 - k]).query(arrays[k])[1] for k in (0, 1)]
        nearest = [torch.from_numpy(np.asarray(rows, dtype=np.int64)).to(a.device)[None] for rows in found]
        return nearest[0], nearest[1]
    a, b = a.masked_fill(~has_a[..., None], -FAR_AWAY_M), b.masked_fill(~has_b[..., None], FAR_AWAY_M)
    squared = torch.baddbmm(a.square().sum(dim=2, keepdim=True), a, b.transpose(1, 2), alpha=-2.0)
    squared = squared + b.square().sum(dim=2)[:, None]
    return squared.argmin(dim=2), squared.argmin(dim=1)


def _evaluate(
    problem: FitProblem,
    mean: Float64Array,
    net: NetBatch,
    num_iterations: Tensor,
    data_term: Tensor,
    params: FlowParams,
) -> FitResult:
    """Evaluate the best iterate at all points; a voted start stays where the net does not explain them better."""
    with torch.no_grad():
        device = net.layers[0].device
        points = torch.from_numpy((problem.points - mean).astype(np.float32))[None].to(device)
        flow = net(points)[0].cpu().numpy() + problem.start_m.astype(np.float32)
    is_finite = bool(np.isfinite(flow).all() and torch.isfinite(data_term))
    if is_finite and params.has("voted_start"):
        tree = build_tree(problem.target)
        start = np.broadcast_to(problem.start_m.astype(np.float32), flow.shape)
        residuals = [residuals_m(tree, problem.points + moved, RESIDUAL_CUTOFF_M).mean() for moved in (start, flow)]
        if residuals[1] > params.max_fit_residual_share * residuals[0]:
            flow = start.copy()
    return FitResult(flow, int(num_iterations), float(data_term), is_finite)
