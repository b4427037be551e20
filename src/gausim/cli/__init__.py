"""The commands of gausim."""
