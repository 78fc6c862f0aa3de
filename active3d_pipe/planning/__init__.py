"""Next best view and path: candidates, visibility, reward, risk field, RRT*, decisions. Sees the map only."""
