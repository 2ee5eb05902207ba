//! Topics between processes: the service of a run that carries CAN frames.

use crate::topic::Transport;
use tandem_board_host::RunName;
use tandem_observers::{Frame, ServicePayload, ServicePublisher, ServiceSubscriber};

pub(crate) struct Service(RunName);

impl Transport for Service {
    type Value = Frame;
    type Publisher = ServicePublisher<Frame>;
    type Subscriber = ServiceSubscriber<Frame>;
    const DEPTH: u32 = Frame::KEPT as u32;
    const LATE: u32 = 0;
    const SUBSCRIBERS: usize = 3;

    fn start() -> Self {
        Self(RunName::unique())
    }

    fn value(number: u32) -> Frame {
        Frame::new(number.into(), number, 2, 0, &[number as u8; 64])
    }

    fn publisher(&self, _: u32) -> Self::Publisher {
        ServicePublisher::create(&self.0).unwrap()
    }

    fn subscriber(&self) -> Self::Subscriber {
        ServiceSubscriber::on(&self.0).unwrap()
    }

    fn fill(place: &mut Frame, value: Frame) -> *const u8 {
        *place = value;
        std::ptr::from_ref(place).cast()
    }

    fn read(view: &Frame) -> (Frame, *const u8) {
        (*view, std::ptr::from_ref(view).cast())
    }
}
