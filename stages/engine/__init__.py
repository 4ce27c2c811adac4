"""What runs stages: the stage record, the workspace on disk, fingerprints and the runner. It knows no stage."""
