"""What a skill is made of, found in demonstrations: operators that matter, components."""
