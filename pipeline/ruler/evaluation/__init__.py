"""The ruler: models of any origin measured against true models or against classified points."""
