"""What runs stages: stage record, workspace on disk, fingerprints, runner. It knows no stage."""
