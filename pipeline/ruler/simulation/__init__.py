"""Simulated scenes with exact truth: parametric roofs, terrain, trees and cars, seen by an airborne laser scanner.

Begin with `simulated_scene.py` (what a scene is), `suites.py` (the named scenes), `als.py` (the scanner) and
`dataset.py` (scene and truth as files). Roofs go from `roof_dimensions.py` over `roof_parts.py` to `envelope.py`.
"""
