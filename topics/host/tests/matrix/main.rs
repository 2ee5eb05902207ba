//! Topics between Tandem, Eclipse Cyclone DDS and dust_dds: a test for each pair and kind.
//!
//! Each cell is a process in a network namespace of its own. Cyclone DDS runs in Python: the
//! interpreter in `TANDEM_PYTHON`, or `python3`, with `cyclonedds` 11.0.1. A cell whose tools are
//! missing says `SKIPPED`. `cargo xtask campaign topics` prints the table of all cells.
//!
//! There is no cell for a late volatile reader of dust_dds and a writer of Cyclone DDS: that reader
//! asks for old frames, and that writer sends them, or not.
#![allow(clippy::unwrap_used)]
#![allow(clippy::print_stdout, reason = "skipped cells and figures are told")]

mod cell;
mod cyclone;
mod dust;
mod frame;
mod kinds;
mod peer;
mod relay;
mod tandem;

use cell::{Pair, cell};
use peer::Vendor::{Cyclone, Dust, Tandem};

mod plain {
    use super::*;

    /// D-2, D-4
    #[test]
    fn tandem_to_tandem() {
        cell("plain", Pair(Tandem, Tandem), kinds::plain);
    }

    /// D-2, D-4
    #[test]
    fn tandem_to_cyclone() {
        cell("plain", Pair(Tandem, Cyclone), kinds::plain);
    }

    /// D-2, D-4
    #[test]
    fn cyclone_to_tandem() {
        cell("plain", Pair(Cyclone, Tandem), kinds::plain);
    }

    /// D-2, D-4
    #[test]
    fn tandem_to_dust() {
        cell("plain", Pair(Tandem, Dust), kinds::plain);
    }

    /// D-2, D-4
    #[test]
    fn dust_to_tandem() {
        cell("plain", Pair(Dust, Tandem), kinds::plain);
    }

    /// D-2, D-4
    #[test]
    fn cyclone_to_dust() {
        cell("plain", Pair(Cyclone, Dust), kinds::plain);
    }

    /// D-2, D-4
    #[test]
    fn dust_to_cyclone() {
        cell("plain", Pair(Dust, Cyclone), kinds::plain);
    }
}

mod late_joiner {
    use super::*;

    /// D-4
    #[test]
    fn tandem_to_tandem() {
        cell("late_joiner", Pair(Tandem, Tandem), kinds::late_joiner);
    }

    /// D-4
    #[test]
    fn tandem_to_cyclone() {
        cell("late_joiner", Pair(Tandem, Cyclone), kinds::late_joiner);
    }

    /// D-4
    #[test]
    fn cyclone_to_tandem() {
        cell("late_joiner", Pair(Cyclone, Tandem), kinds::late_joiner);
    }

    /// D-4
    #[test]
    fn tandem_to_dust() {
        cell("late_joiner", Pair(Tandem, Dust), kinds::late_joiner);
    }

    /// D-4
    #[test]
    fn dust_to_tandem() {
        cell("late_joiner", Pair(Dust, Tandem), kinds::late_joiner);
    }

    /// D-4
    #[test]
    fn cyclone_to_dust() {
        cell("late_joiner", Pair(Cyclone, Dust), kinds::late_joiner);
    }

    /// D-4
    #[test]
    fn dust_to_cyclone() {
        cell("late_joiner", Pair(Dust, Cyclone), kinds::late_joiner);
    }
}

mod late_volatile {
    use super::*;

    /// D-4
    #[test]
    fn tandem_to_tandem() {
        cell("late_volatile", Pair(Tandem, Tandem), kinds::late_volatile);
    }

    /// D-4
    #[test]
    fn tandem_to_cyclone() {
        cell("late_volatile", Pair(Tandem, Cyclone), kinds::late_volatile);
    }

    /// D-4
    #[test]
    fn cyclone_to_tandem() {
        cell("late_volatile", Pair(Cyclone, Tandem), kinds::late_volatile);
    }

    /// D-4
    #[test]
    fn tandem_to_dust() {
        cell("late_volatile", Pair(Tandem, Dust), kinds::late_volatile);
    }

    /// D-4
    #[test]
    fn dust_to_tandem() {
        cell("late_volatile", Pair(Dust, Tandem), kinds::late_volatile);
    }

    /// D-4
    #[test]
    fn dust_to_cyclone() {
        cell("late_volatile", Pair(Dust, Cyclone), kinds::late_volatile);
    }
}

mod loss {
    use super::*;

    /// D-2, D-4
    #[test]
    fn tandem_to_tandem() {
        cell("loss", Pair(Tandem, Tandem), kinds::loss);
    }

    /// D-2, D-4
    #[test]
    fn tandem_to_cyclone() {
        cell("loss", Pair(Tandem, Cyclone), kinds::loss);
    }

    /// D-2, D-4
    #[test]
    fn cyclone_to_tandem() {
        cell("loss", Pair(Cyclone, Tandem), kinds::loss);
    }

    /// D-2, D-4
    #[test]
    fn tandem_to_dust() {
        cell("loss", Pair(Tandem, Dust), kinds::loss);
    }

    /// D-2, D-4
    #[test]
    fn dust_to_tandem() {
        cell("loss", Pair(Dust, Tandem), kinds::loss);
    }

    /// D-2, D-4
    #[test]
    fn cyclone_to_dust() {
        cell("loss", Pair(Cyclone, Dust), kinds::loss);
    }

    /// D-2, D-4
    #[test]
    fn dust_to_cyclone() {
        cell("loss", Pair(Dust, Cyclone), kinds::loss);
    }
}

mod wrong_reliability {
    use super::*;

    /// D-4
    #[test]
    fn tandem_to_tandem() {
        cell(
            "wrong_reliability",
            Pair(Tandem, Tandem),
            kinds::wrong_reliability,
        );
    }

    /// D-4
    #[test]
    fn tandem_to_cyclone() {
        cell(
            "wrong_reliability",
            Pair(Tandem, Cyclone),
            kinds::wrong_reliability,
        );
    }

    /// D-4
    #[test]
    fn cyclone_to_tandem() {
        cell(
            "wrong_reliability",
            Pair(Cyclone, Tandem),
            kinds::wrong_reliability,
        );
    }

    /// D-4
    #[test]
    fn tandem_to_dust() {
        cell(
            "wrong_reliability",
            Pair(Tandem, Dust),
            kinds::wrong_reliability,
        );
    }

    /// D-4
    #[test]
    fn dust_to_tandem() {
        cell(
            "wrong_reliability",
            Pair(Dust, Tandem),
            kinds::wrong_reliability,
        );
    }

    /// D-4
    #[test]
    fn cyclone_to_dust() {
        cell(
            "wrong_reliability",
            Pair(Cyclone, Dust),
            kinds::wrong_reliability,
        );
    }

    /// D-4
    #[test]
    fn dust_to_cyclone() {
        cell(
            "wrong_reliability",
            Pair(Dust, Cyclone),
            kinds::wrong_reliability,
        );
    }
}

mod wrong_durability {
    use super::*;

    /// D-4
    #[test]
    fn tandem_to_tandem() {
        cell(
            "wrong_durability",
            Pair(Tandem, Tandem),
            kinds::wrong_durability,
        );
    }

    /// D-4
    #[test]
    fn tandem_to_cyclone() {
        cell(
            "wrong_durability",
            Pair(Tandem, Cyclone),
            kinds::wrong_durability,
        );
    }

    /// D-4
    #[test]
    fn cyclone_to_tandem() {
        cell(
            "wrong_durability",
            Pair(Cyclone, Tandem),
            kinds::wrong_durability,
        );
    }

    /// D-4
    #[test]
    fn tandem_to_dust() {
        cell(
            "wrong_durability",
            Pair(Tandem, Dust),
            kinds::wrong_durability,
        );
    }

    /// D-4
    #[test]
    fn dust_to_tandem() {
        cell(
            "wrong_durability",
            Pair(Dust, Tandem),
            kinds::wrong_durability,
        );
    }

    /// D-4
    #[test]
    fn cyclone_to_dust() {
        cell(
            "wrong_durability",
            Pair(Cyclone, Dust),
            kinds::wrong_durability,
        );
    }

    /// D-4
    #[test]
    fn dust_to_cyclone() {
        cell(
            "wrong_durability",
            Pair(Dust, Cyclone),
            kinds::wrong_durability,
        );
    }
}

mod third_reader {
    use super::*;

    /// D-4
    #[test]
    fn tandem_to_tandem() {
        cell("third_reader", Pair(Tandem, Tandem), kinds::third_reader);
    }

    /// D-4
    #[test]
    fn tandem_to_cyclone() {
        cell("third_reader", Pair(Tandem, Cyclone), kinds::third_reader);
    }

    /// D-4
    #[test]
    fn tandem_to_dust() {
        cell("third_reader", Pair(Tandem, Dust), kinds::third_reader);
    }
}
