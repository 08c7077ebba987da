"""Public recordings of real hands, which everybody fetches from their authors; none is part of handsim."""
