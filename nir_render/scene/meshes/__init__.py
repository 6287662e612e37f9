"""Triangle meshes from files of Blender and CAD, looked into before anything is rendered."""
