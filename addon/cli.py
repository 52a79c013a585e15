"""`blender -c fieldwork VERB …`."""
