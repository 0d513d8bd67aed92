"""PyBullet's own renderers: each fills a client of its own with the shapes that it is to draw."""
