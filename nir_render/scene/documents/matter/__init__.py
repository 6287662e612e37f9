"""What materials are made of: where their figures come from, pictures of reflectance, retroreflection."""
