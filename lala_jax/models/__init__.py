"""Networks: maps in, pick and place logits out."""
