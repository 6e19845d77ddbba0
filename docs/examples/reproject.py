"""Reprojects result files by the equations of docs/results.md, and compares with their residuals.

    python docs/examples/reproject.py DIR INPUT

DIR is the output of `scpsfm solve INPUT --out DIR`, INPUT its CSV. Needs numpy. Exit code 1: an equation is off by more
than 1e-6 px.
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np

LENS = ("radial_k1", "radial_k2", "radial_k3", "tangential_p1", "tangential_p2")


def radial(view, r):
    """g(r) = r s(r)."""
    k1, k2, k3 = (view[name] for name in LENS[:3])
    t = np.arctan(r) if view["lens_projection"] == "FISHEYE" else r
    return t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6)


def lens(view, q):
    u, v = q
    r2 = u * u + v * v
    s = radial(view, np.sqrt(r2)) / np.sqrt(r2) if r2 > 0 else 1.0
    p1, p2 = (0.0, 0.0) if view["lens_projection"] == "FISHEYE" else (view[name] for name in LENS[3:])
    return np.array([u * s + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * s + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v])


def undistorted(view, distorted):
    """The inverse of `lens`, by Newton's method."""
    q = distorted.copy()
    for _ in range(50):
        step = 1e-7 * np.eye(2)
        jacobian = np.column_stack([(lens(view, q + h) - lens(view, q - h)) / 2e-7 for h in step])
        change = np.linalg.solve(jacobian, distorted - lens(view, q))
        q += change
        if np.abs(change).max() < 1e-14:
            break
    return q


def points(directory, parts):
    """Part, track and split to the coordinates of the point."""
    found = {}
    for part in range(parts):
        text = (directory / ("points.ply" if part == 0 else f"points-part-{part}.ply")).read_text()
        for line in text.split("end_header\n")[1].splitlines():
            x, y, z, *_, track, split = line.split()
            found[part, track, split] = np.array([x, y, z], float)
    return found


def main(directory, path):
    views = json.loads((directory / "cameras.json").read_text())["views"]
    parts = 1 + max((view["part"] or 0 for view in views), default=0)
    point, first = points(directory, parts), {}
    for view in views:
        view.update((name, np.array(view[name])) for name in ("P", "K", "R", "t") if view[name] is not None)
        if view["registered"]:
            first.setdefault(view["part"], view)
    by_label = {str(view["view"]): view for view in views}
    off = {"P": [0.0], "K [R|t] and P": [0.0], "residual_px": [0.0]}
    observations, inputs = (csv.DictReader(open(file, newline="")) for file in (directory / "observations.csv", path))
    for observation, given in zip(observations, inputs, strict=True):
        view = by_label[observation["view"]]
        X = point.get((view["part"], observation["track"], "0"))
        if observation["inlier"] == "0" or X is None:
            continue
        z, P, one = np.array([given["x"], given["y"]], float), view["P"], first[view["part"]]
        if view["K"] is None:
            Y = np.append(X, 1)
            x = (P @ Y)[:2] / (P @ Y)[2]
            residual = np.linalg.norm(z - x)
        else:
            K, R, t = view["K"], view["R"], view["t"]
            K1, R1, t1 = one["K"], one["R"], one["t"]
            q = (R @ X + t)[:2] / (R @ X + t)[2]
            Y = np.append(K1 @ (R1 @ X + t1), 1)
            pinhole = (K @ np.append(q, 1))[:2]
            off["K [R|t] and P"].append(np.abs((P @ Y)[:2] / (P @ Y)[2] - pinhole).max())
            right = K @ np.column_stack([R @ R1.T @ np.linalg.inv(K1), t - R @ R1.T @ t1])
            off["P"].append(np.abs(P - right).max())
            seen = undistorted(view, (np.linalg.inv(K) @ np.append(z, 1))[:2])
            rho, h = np.linalg.norm(seen), 1e-6
            area = radial(view, rho) / rho * (radial(view, rho + h) - radial(view, rho - h)) / (2 * h) if rho > h else 1
            residual = np.sqrt(area) * np.linalg.norm((K @ np.append(seen, 1))[:2] - pinhole)
        off["residual_px"].append(abs(residual - float(observation["residual_px"])))
    for name, differences in off.items():
        print(f"{name}: {len(differences) - 1} compared, largest difference {max(differences):.1e}")
    return int(max(map(max, off.values())) > 1e-6)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2]))
