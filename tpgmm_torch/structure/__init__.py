"""Structure of a skill, found in demonstrations: operators that matter, components."""
