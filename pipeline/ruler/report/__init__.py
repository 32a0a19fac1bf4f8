"""Pages and pictures of the ruler: `evaluation_page.py`, `comparison_page.py` (methods), `epochs_page.py` (two runs).

Their templates are in `templates/`; styles and maps come from `pipeline.report`.
"""
