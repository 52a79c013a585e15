"""How the objects of a capture are recognised in a scene: by custom properties, so that they may be renamed."""

ROLE, PROJECT = "fieldwork_role", "fieldwork_project"
