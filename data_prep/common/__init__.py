"""What the stages share: all or nothing, photos, progress, the command line."""
