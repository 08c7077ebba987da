"""Public recordings of real hands, which everybody fetches from their authors: none of them is part of handsim."""
