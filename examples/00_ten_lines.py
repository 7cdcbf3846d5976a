"""From blurry frames and events to a sharp scene, in ten lines; `help(sf.train)` says the rest.

    python examples/00_ten_lines.py

takes a minute or two. With a capture of your own, begin with `sf.read("FOLDER")` or only name the
folder. The same from the command line: `sharpfield simulate`, `train`, `evaluate`, `export`.
"""

import sharpfield as sf

capture = sf.simulate("garden", size=(120, 80), frames=18, motion="shaky", seed=0)
print(capture)
run = sf.train("ev-splat", capture, out="runs/ten_lines", minutes=1)
print(run)
blurry = run.render(3, exposure=True)  # [h, w, 3] in 0...1: what frame 3 recorded
sharp = run.render(3)  # the same view without its blur
print(f"frame 3 was off by {abs(sharp - blurry).mean():.3f} on average")
print(f"held-out views: {run.evaluate()['mean']['psnr']:.1f} dB")
print(f"{run.export('ten_lines.ply'):,} Gaussians are in ten_lines.ply")
