"""The library `particles` as a row of the benchmark: a process of its own, because it needs NumPy < 2.

Reads one JSON document a line from standard input and answers each with one line: the problem first (F, Q, H, R, P0,
ys), then {"particles": n, "seed": s} -> {"seconds": CPU time, "log_likelihood": ..., "means": ...}.
"""

import importlib.metadata
import json
import sys
import time

import numpy as np
import particles
from particles import collectors, kalman, state_space_models


def main() -> None:
    problem = {name: np.array(value) for name, value in json.loads(sys.stdin.readline()).items()}
    model = kalman.MVLinearGauss(
        F=problem["F"],
        G=problem["H"],
        covX=problem["Q"],
        covY=problem["R"],
        mu0=np.zeros(len(problem["F"])),
        cov0=problem["P0"],
    )
    ys = list(problem["ys"])
    versions = {"python": sys.version.split()[0]}
    versions |= {name: importlib.metadata.version(name) for name in ("numpy", "numba", "particles")}
    print(json.dumps(versions), flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        np.random.seed(job["seed"])
        start = time.process_time()
        feynman_kac = state_space_models.Bootstrap(ssm=model, data=ys)
        # The filter resamples when the effective sample size is below ESSrmin * n: always, for a number above 1.
        filter_ = particles.SMC(
            fk=feynman_kac,
            N=job["particles"],
            resampling="systematic",
            ESSrmin=1.1,
            collect=[collectors.Moments(mom_func=lambda weights, x: weights @ x)],
        )
        filter_.run()
        seconds = time.process_time() - start
        answer = {"seconds": seconds, "log_likelihood": float(filter_.logLt)}
        answer["means"] = np.array(filter_.summaries.moments).tolist()
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
