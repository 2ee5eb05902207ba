//! The sensors on the bus: five radars and one camera. T-CHIP-4

use crate::{SensorHeader, SensorId, SensorObject};

impl SensorId {
    /// Returns 0 ..= 5: the index in [`SensorId::ALL`].
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Returns the id of the frame that begins an object list.
    #[must_use]
    pub const fn header_id(self) -> u16 {
        SensorHeader::IDS[self.index()]
    }

    /// Returns the id of the frames that carry the objects.
    #[must_use]
    pub const fn object_id(self) -> u16 {
        SensorObject::IDS[self.index()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FRAMES;

    /// T-CHIP-4: the ids of the six sensors are those of the DBC.
    #[test]
    fn ids_are_those_of_the_dbc() {
        let name_of = |id| FRAMES.iter().find(|frame| frame.id == id).unwrap().name;
        for sensor in SensorId::ALL {
            assert_eq!(
                name_of(sensor.header_id()).strip_suffix("Header"),
                Some(sensor.name())
            );
            assert_eq!(
                name_of(sensor.object_id()).strip_suffix("Object"),
                Some(sensor.name())
            );
            assert_eq!(SensorId::ALL[sensor.index()], sensor);
        }
    }
}
