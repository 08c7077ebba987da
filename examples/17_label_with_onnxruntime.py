"""Label the markers of one hand from an ONNX file, with numpy, scipy and onnxruntime alone.

    handsim export dense19 --out dense19.onnx
    python examples/17_label_with_onnxruntime.py dense19.onnx

Copy `open_labeler`, `compare` and `label` into a program that has no handsim. Without a file the example
exports the labeler of dense19 first.
"""

from __future__ import annotations

import base64
import io
import json
import subprocess
import sys
import tempfile

import numpy as np
import onnxruntime
from scipy.optimize import linear_sum_assignment


def open_labeler(path):
    """The network, the constants of the matching, and the pose prior of right hands and of left ones."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    stored = np.load(io.BytesIO(base64.b64decode(metadata["handsim.pose_prior"])))
    prior = {name: np.concatenate([stored[name], stored[name]]).astype(float) for name in stored}
    for name in ("means", "directions"):
        prior[name][len(stored[name]) :, :, 0] *= -1.0  # a left hand is a right one in a mirror
    return session, json.loads(metadata["handsim.matching"]), prior


def compare(points, labels, poses, k, prior):
    """Log-density of a hand that is labeled so, and the poses nearest to it."""
    known = labels >= 0
    cloud, hands = points[known], prior["means"][poses][:, labels[known]]
    cloud, hands = cloud - cloud.mean(axis=0), hands - hands.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(cloud.T @ hands)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]  # the cloud is turned onto each hand, not mirrored
    residuals = (cloud @ u @ vt - hands).reshape(len(poses), -1, 1)
    order = np.argsort((residuals**2).sum(axis=(1, 2)))[: k["near"]]
    best, residuals = poses[order[: k["nearest"]]], residuals[order[: k["nearest"]]]
    modes = prior["directions"][best][:, labels[known]].reshape(*residuals.shape[:2], -1)
    covariance = modes @ modes.mT + prior["spreads"][best, None, None] ** 2 * np.eye(residuals.shape[1])
    distance = (residuals.mT @ np.linalg.solve(covariance, residuals)).ravel()
    logs = prior["log_weights"][best] - (np.linalg.slogdet(2 * np.pi * covariance)[1] + distance) / 2
    return np.logaddexp.reduce(logs), poses[order]


def label(points, session, k, prior):
    """Labels (N,) of the points (N, 3) [m] of one hand: numbers of markers, -1 for a ghost."""
    given = {"points": np.float32([points - points.mean(axis=0)]), "present": np.ones((1, len(points)), bool)}
    (pairs,), (costs,) = session.run(["pairs", "costs"], given)

    found, tries, near = [], [np.empty((0, 2), int)], None  # tries: pairs left out
    sides = np.split(np.arange(len(prior["means"])), 2)  # the poses of right hands and of left ones
    for _ in range(k["rounds"] + 1):
        front = []
        for taken in tries:
            left = costs.copy()
            left[tuple(taken.T)] = k["impossible"]
            rows, columns = linear_sum_assignment(left)
            labels, cost = np.where(columns < pairs.shape[1] - 1, columns, -1), left[rows, columns].sum()
            few = (labels >= 0).sum() < k["least_points"]
            if few and not found:  # nearly all are ghosts, and no pose is asked
                return labels
            if not found:  # the likeliest labels choose the side, the nearest poses, and the largest cost
                near = max(
                    (compare(points, labels, side, k, prior) for side in sides), key=lambda one: one[0]
                )[1]
                most = cost + k["farthest"]
            elif cost > most or any((labels == one[3]).all() for one in found + front):
                continue
            density = -np.inf if few else compare(points, labels, near, k, prior)[0]
            score = k["prior_weight"] * (density + k["ghost"] * (labels < 0).sum()) - cost
            front.append((score, density / max(1, 3 * (labels >= 0).sum()), taken, labels, columns))
        found, tries = found + front, []
        for _, _, taken, labels, columns in sorted(front, key=lambda one: -one[0])[: k["width"]]:
            unsure = np.argsort(pairs[rows, labels])[: k["most_unsure"]]
            tries += [np.vstack([taken, (i, columns[i])]) for i in unsure if pairs[i, labels[i]] < k["sure"]]
    best = max(found, key=lambda one: one[0])
    return best[3] if best[1] >= k["least_density"] else found[0][3]


def main(path: str) -> None:
    """Label a hand whose markers are known: the first mean hand of the file, in random order."""
    session, k, prior = open_labeler(path)
    order = np.random.default_rng(0).permutation(prior["means"].shape[1])
    found = label(prior["means"][0][order], session, k, prior)
    print(f"{(found == order).sum()} of {len(order)} markers are labeled right: {found.tolist()}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/dense19.onnx"
            subprocess.run([sys.executable, "-m", "handsim", "export", "dense19", "--out", path], check=True)
            main(path)
