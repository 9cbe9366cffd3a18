"""Which equations, and which price of a coefficient, make the intervals of an early warning hold."""
import sys
import numpy as np, pandas as pd, siq, scipy.special
from siq.workflow import tipping as tp
from benchmarks.early_warning import made, truth, family, indicators
kind, first, count, out = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
PEN = {"bic": lambda n: 0.5 * np.log(n), "aic": lambda n: 1.0, "half": lambda n: 0.25 * np.log(n)}
def drawn_with(fams, pen):
    def drawn(values, cov, independent, generator):
        found = []
        for o, m in fams:
            kept = np.array([*range(o), *range(tp.ORDERS, tp.ORDERS + m)]); rest = np.setdiff1d(np.arange(len(values)), kept)
            gain = np.linalg.solve(cov[np.ix_(rest, rest)], cov[np.ix_(rest, kept)]); mean = values[kept] - values[rest] @ gain
            sp = cov[np.ix_(kept, kept)] - cov[np.ix_(kept, rest)] @ gain
            mis = float(values[rest] @ np.linalg.solve(cov[np.ix_(rest, rest)], values[rest])) if len(rest) else 0
            found.append((kept, mean, sp, -.5 * mis - len(kept) * PEN[pen](max(independent, 3))))
        w = scipy.special.softmax([f[3] for f in found]); fam = generator.choice(len(found), size=tp.DRAWS, p=w)
        d = np.zeros((tp.DRAWS, len(values)))
        for k, (kept, mean, sp, _) in enumerate(found):
            r = np.flatnonzero(fam == k); d[np.ix_(r, kept)] = generator.multivariate_normal(mean, sp, size=len(r), method="eigh")
        return d, dict(zip(fams, map(float, w)))
    return drawn
tp.MOMENTS = 2
cache = {}
of = tp.fit_by_filter
def ff(m, d, **k):
    if "f" not in cache: cache["f"] = of(m, d, **k)
    return cache["f"]
tp.fit_by_filter = ff
f4 = ((4, 2), (4, 1), (3, 2), (3, 1)); f5 = ((5, 2), (5, 1)) + f4
V = {"4bic": (4, "bic", f4), "4half": (4, "half", f4), "4aic": (4, "aic", f4), "3": (4, "bic", ((3, 2), (3, 1))), "5bic": (5, "bic", f5), "5aic": (5, "aic", f5), "window": (4, "bic", ((4, 0), (3, 0)))}
rows = []
from pathlib import Path; Path(out).parent.mkdir(parents=True, exist_ok=True)
for seed in range(first, first + count):
    L = made(kind, seed); p, frozen = truth(L, family(kind, bool(seed % 2))[4])
    base = dict(kind=kind, seed=seed, begin=L.begin, end=L.end, frozen=frozen, samples=len(L.t), tips=np.random.default_rng(seed).random() < p[-1])
    base["variance"], base["correlation"] = indicators(L.x)
    cache.clear(); before = None
    for name, (O, pen, fams) in V.items():
        if before != (O, name == "window"): cache.clear()
        before = (O, name == "window"); tp.ORDERS = O; tp._drawn = drawn_with(fams, pen)
        frame = pd.DataFrame({"t": L.t, "x": L.x})
        try:
            w = siq.early_warning(frame[-len(frame) // 3:] if name == "window" else frame, until=L.until, seed=seed)
        except Exception as error:
            rows.append(base | {"variant": name, "error": repr(error)}); continue
        row = base | {"variant": name, "falling": w.falling, "remarks": " ".join(one.code for one in w.remarks)}
        for k, place in enumerate((15, 30, 60)):
            now = w.probability.iloc[place]
            row |= {f"truth_{k}": p[place], f"probability_{k}": now["probability"], f"lower_{k}": now["lower"], f"upper_{k}": now["upper"]}
        for nm, at in (("first", 0), ("last", -1)):
            row |= {f"{nm}_{c}": v for c, v in w.course.iloc[at].items()}
        rows.append(row)
    pd.DataFrame(rows).to_csv(out, index=False)
