"""Print what the AV-21 files say of wheel radii, of the reference's point, and of how much sideslip there is to estimate.

    VEHEST_DATA=FOLDER python docs/identify_av21.py

conf/dataset/av21.yaml declares the constants, docs/sources/av21.md explains them.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from identification import data_folder, regression

FILES = ("LVMS_23_01_04_B", "Putnam_park2023_run4_2")
MOVING = 5.0  # m/s
NOMINAL = 0.3  # m, by which speeds at the rim become rotational speeds; the publishers give no radius


def main() -> None:
    """Print every figure."""
    ratios = []
    for stem in FILES:
        table = pd.read_csv(data_folder() / "av21" / f"{stem}.csv")
        time, vx, vy, r = (table[name].to_numpy(np.float64) for name in ("# time(s)", "vx(m/s)", "vy(m/s)", "omega(rad/s)"))
        moving = vx > MOVING
        what = f"{len(table)} rows, {time[-1] - time[0]:.1f} s from {time[0]:.2f} s"
        print(f"{stem}: {what}, {moving.sum()} rows faster than {MOVING:g} m/s, to {vx.max():.1f} m/s")
        wheels = {name: table[f"wheel_{name}(kmph)"].to_numpy(np.float64) / 3.6 for name in ("fl", "fr", "rl", "rr")}
        for name, speed in wheels.items():
            (gain, side, traction), rest = regression([vx, r, np.gradient(vx, time)], speed, moving)
            print(f"  wheel {name}: {gain:.4f} vx {side:+.2f} m r {traction:+.3f} s dvx/dt, rest {rest:.3f} m/s")
        mean = np.mean(list(wheels.values()), axis=0)
        ratio = float(np.median(mean[moving] / vx[moving]))
        ratios.append(ratio)
        delays = np.arange(-0.2, 0.21, 0.02)
        scored = [(float(np.std((mean / ratio - np.interp(time - delay, time, vx))[moving])), delay) for delay in delays]
        print(f"  mean of the wheels: {ratio:.4f} vx, {1e3 * min(scored)[1]:.0f} ms late (rest {min(scored)[0]:.3f} m/s)")
        sideslip = np.degrees(np.arctan2(vy[moving], vx[moving]))
        print(
            f"  v_y correlates with the yaw rate by {np.corrcoef(vy[moving], r[moving])[0, 1]:.2f}; |sideslip| below "
            f"{np.quantile(np.abs(sideslip), 0.99):.2f}° for 99 % of that time; |v_y| to {np.abs(vy).max():.2f} m/s"
        )
        straight = moving & (np.abs(r) < 0.01)
        angle = np.degrees(np.arctan2(vy, vx)[straight].mean())
        print(f"  straight on (|r| < 0.01 rad/s, {straight.sum()} rows) the mean sideslip is {angle:+.2f}°")
    both = float(np.mean(ratios))
    errors = " and ".join(f"{100 * (ratio / both - 1):+.2f} %" for ratio in ratios)
    print(f"wheel radius: {NOMINAL:g} m by {both:.4f} is {NOMINAL / both:.4f} m; errors of the speed by file {errors}")


if __name__ == "__main__":
    main()
