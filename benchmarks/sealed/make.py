"""Make a sealed set of recordings: folders that a diagnosis may see, and the key apart.

    python benchmarks/sealed/make.py --seed 1 --out sets/one --count 300

writes DIR/recordings/rNNNN/ in random order, DIR/key/key.json and DIR/key/rNNNN.npz (change of the
noise-free measurements by all that is hidden, and by each effect alone), and DIR/HASH.txt, the
SHA-256 of key.json, which itself holds the SHA-256 of every npz: whoever publishes the hash first
can open the key later without anyone doubting it.
"""

import argparse
import hashlib
import json
import os
from pathlib import Path

# Sums by several threads, or eight at a time, differ in their last bits, and with them the hash of
# the key: the same set has the same hash on processors with and without AVX-512.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["OPENBLAS_CORETYPE"] = "Haswell"
os.environ["NPY_DISABLE_CPU_FEATURES"] = "X86_V4 AVX512_ICL AVX512_SPR"

import numpy as np
from world import EFFECTS, KINDS, record

SHARES = {"nothing": 60, "outside": 45, "two": 60, "single": 135}
"""How many of 300 recordings hide nothing, an effect outside any list, two effects, one."""


def main():
    """Read the command line, make the set, print the hash."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--only", nargs="+", help="kinds, effects or classes to keep", default=())
    args = parser.parse_args()
    print(make(args.seed, args.out, args.count, tuple(args.only)))


def make(seed, out, count=300, only=()):
    """Write the set and return the hash of its key."""
    rng = np.random.default_rng([seed, 7])
    wanted = [w for w in plan_set(rng, count) if not only or _kept(w, only)]
    wanted = [wanted[k] for k in rng.permutation(len(wanted))]
    (out / "key").mkdir(parents=True)
    entries = []
    for number, (kind, hidden) in enumerate(wanted):
        name = f"r{number:04d}"
        size = "large" if kind == "station" and rng.random() < 0.08 else "normal"
        made = record(kind, int(rng.integers(2**31)), hidden, size=size)
        made.write(out / "recordings" / name)
        entries.append({"id": name, **made.truth, "npz_sha256": _save(out / "key", name, made)})
    text = json.dumps(entries, indent=1)
    (out / "key" / "key.json").write_text(text, encoding="utf-8")
    digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
    (out / "HASH.txt").write_text(digest + "\n", encoding="utf-8")
    return digest


def plan_set(rng, count):
    """Pairs (kind, hidden effects) for a whole set, spread evenly over kinds and effects."""
    number = {name: round(count * share / 300) for name, share in SHARES.items()}
    number["single"] = count - sum(n for name, n in number.items() if name != "single")
    listed = [e for e in EFFECTS.values() if not e.outside]
    strange = [e for e in EFFECTS.values() if e.outside]
    used = {kind: 0 for kind in KINDS}

    def kind_of(kinds):
        least = min(used[k] for k in kinds)
        kind = str(rng.choice([k for k in kinds if used[k] == least]))
        used[kind] += 1
        return kind

    singles = _deck(rng, listed, number["single"] + 2 * number["two"])
    pairs, left = _couples(rng, singles, number["two"])
    left = sorted(left, key=lambda e: len(e.kinds))
    out = []
    for one, other in pairs:
        kinds = [k for k in KINDS if k in one.kinds and k in other.kinds]
        out.append((kind_of(kinds), (one.key, other.key)))
    out += [(kind_of(e.kinds), (e.key,)) for e in left]
    out += [(kind_of(e.kinds), (e.key,)) for e in _deck(rng, strange, number["outside"])]
    out += [(kind_of(KINDS), ()) for _ in range(number["nothing"])]
    return out


def _deck(rng, effects, count):
    """So many effects, each as often as any other (to one)."""
    deck = []
    while len(deck) < count:
        deck += [effects[k] for k in rng.permutation(len(effects))]
    return deck[:count]


def _couples(rng, deck, count):
    """Take so many couples out of a deck that can stand in one scene and are of two stages."""
    deck, pairs = [deck[k] for k in rng.permutation(len(deck))], []
    while len(pairs) < count:
        one = deck.pop()
        for k, other in enumerate(deck):
            apart = other.key != one.key and other.draw.__module__ != one.draw.__module__
            if apart and set(one.kinds) & set(other.kinds):
                pairs.append((one, deck.pop(k)))
                break
        else:
            deck.insert(0, one)
    return pairs, deck


def _kept(wanted, only):
    kind, hidden = wanted
    classes = ["nothing", "single", "two"][len(hidden)]
    outside = "outside" if any(EFFECTS[key].outside for key in hidden) else classes
    return bool({kind, outside, *hidden} & set(only))


def _save(folder, name, made):
    """Write the changes of a recording; returns the SHA-256 of the file."""
    arrays = {"change": made.change["pixels"], "change_ranges": made.change["ranges"]}
    for i, change in enumerate(made.changes):
        arrays |= {f"change_{i}": change["pixels"], f"change_{i}_ranges": change["ranges"]}
    file = folder / f"{name}.npz"
    np.savez_compressed(file, **arrays)
    return hashlib.sha256(file.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
