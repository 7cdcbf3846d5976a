"""Run all benchmarks, or those whose name contains a word: `python -m benchmarks [WORD]`."""

import subprocess
import sys

NAMES = ("ops", "rasterize", "neighbours", "event_simulator", "training_step", "render_view", "gpu")


def main() -> None:
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    for name in NAMES:
        if word in name:
            print(f"\n== {name}", flush=True)
            subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=True)


if __name__ == "__main__":
    main()
