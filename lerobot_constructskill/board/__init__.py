"""Results that anyone can check: submissions, their replay, and the board made of them."""
