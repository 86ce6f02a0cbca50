"""Pages for web browsers that need no network: what viewers of meshes and scenes share, and the page of a scene."""
