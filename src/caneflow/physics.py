"""Constants of nature, in the one place from which every room takes them."""

GRAVITY = 9.80665  # m/s^2, the standard acceleration of free fall (3rd CGPM, 1901); also the g of data sheets
LOCAL_GRAVITY = 9.81  # m/s^2, of the place that is simulated, as wire.md has it; estimators assume GRAVITY
SPEED_OF_LIGHT = 299_792_458.0  # m/s, exact (SI); in air 0.03 % less, far below every carrier's error
