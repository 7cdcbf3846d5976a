"""Make captures with known truth: scenes, camera paths, blurry frames and events."""
