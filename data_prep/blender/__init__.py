"""The paper's synthetic set: a mesh, a plan, and Blender in an environment of its own."""
