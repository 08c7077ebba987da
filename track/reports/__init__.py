"""The page on a take: what a biomechanics lab looks at before it uses the angles."""
