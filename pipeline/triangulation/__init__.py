"""Triangulation of planar faces with holes, exact on millimetres: no new vertices, no degenerate triangles.

A face is projected along the dominant axis of its normal, so that millimetre coordinates stay integers and every
orientation test is exact. Holes are joined to the outer ring by bridges, the resulting polygon is cut by ear clipping
(Meisters 1975), and edge flips make it a constrained Delaunay triangulation (Lawson 1977). The flips keep thin
triangles away from vertices that lie on a straight edge, so that rounding hardly turns the normals. Cocircular ties
go to the diagonal with the smaller coordinates, so that the result does not depend on where a ring starts.
"""
