"""The model in writing: its equations as text, a law typed in one line, friction as table and C."""
