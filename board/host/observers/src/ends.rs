//! The ends of a service: its publisher and its subscribers, with the interface of
//! `tandem_shm::topic`. A value is written and read in the memory that they share.

use core::fmt::Debug;

use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher as Sending;
use iceoryx2::port::subscriber::Subscriber as Receiving;
use iceoryx2::prelude::{
    LogLevel, NodeBuilder, PortFactory as _, ServiceName, SignalHandlingMode, ZeroCopySend, ipc,
    set_log_level,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use tandem_shm::topic::{Publish, Subscribe};

use tandem_board_host::RunName;

/// Maximum number of simultaneous observers of a run.
const OBSERVERS: usize = 8;

/// Why a service cannot be published or observed, or a value not be published.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct ServiceError(pub(super) String);

fn refused<E: Debug>(what: &str) -> impl FnOnce(E) -> ServiceError {
    let what = what.to_owned();
    move |error| ServiceError(format!("{what}: {error:?}"))
}

/// A value that a service of a run carries.
pub trait ServicePayload: ZeroCopySend + Debug + Copy + Default + 'static {
    /// Last part of the service's name, as in `tandem/RUN/roles`.
    const NAME: &'static str;
    /// Number of samples that are kept for each observer.
    const KEPT: usize;
}

/// The user header of each sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemNumber")]
#[repr(C)]
pub struct SampleNumber {
    /// Counts the samples of the publisher, from 0.
    pub number: u64,
}

pub(super) fn node() -> Result<Node<ipc::Service>, ServiceError> {
    set_log_level(LogLevel::Fatal);
    NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(refused("a node of iceoryx2"))
}

fn name_of<T: ServicePayload>(run: &RunName) -> Result<ServiceName, ServiceError> {
    let text = format!("tandem/{run}/{}", T::NAME);
    ServiceName::new(&text).map_err(refused(&text))
}

/// The publisher of a service. There is one.
#[derive(Debug)]
pub struct ServicePublisher<T: ServicePayload> {
    service: PortFactory<ipc::Service, T, SampleNumber>,
    port: Sending<ipc::Service, T, SampleNumber>,
    next: u64,
}

impl<T: ServicePayload> ServicePublisher<T> {
    /// Creates the service of this run, unless observers of an earlier publisher keep it, and its
    /// publisher.
    ///
    /// # Errors
    /// If iceoryx2 refuses an operation, for example because the service has a publisher.
    pub fn create(run: &RunName) -> Result<Self, ServiceError> {
        Self::create_on(&node()?, run)
    }

    pub(super) fn create_on(
        node: &Node<ipc::Service>,
        run: &RunName,
    ) -> Result<Self, ServiceError> {
        let builder = node.service_builder(&name_of::<T>(run)?);
        let service = builder
            .publish_subscribe::<T>()
            .user_header::<SampleNumber>()
            .max_publishers(1)
            .max_subscribers(OBSERVERS)
            .max_nodes(2 * OBSERVERS)
            .subscriber_max_buffer_size(T::KEPT)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(refused(T::NAME))?;
        let port = service.publisher_builder().create();
        Ok(Self {
            port: port.map_err(refused(T::NAME))?,
            service,
            next: 0,
        })
    }

    /// Returns whether the service has a subscriber.
    #[must_use]
    pub fn is_observed(&self) -> bool {
        self.service.dynamic_config().number_of_subscribers() > 0
    }
}

impl<T: ServicePayload> Publish<T> for ServicePublisher<T> {
    type Place<'a> = T;
    type Error = ServiceError;

    /// Without a subscriber the value is dropped, and not counted.
    fn publish_with(&mut self, fill: impl FnOnce(&mut T)) -> Result<(), ServiceError> {
        if !self.is_observed() {
            return Ok(());
        }
        let mut sample = self.port.loan().map_err(refused(T::NAME))?;
        fill(sample.payload_mut());
        sample.user_header_mut().number = self.next;
        sample.send().map_err(refused(T::NAME))?;
        self.next += 1;
        Ok(())
    }

    fn publish(&mut self, value: &T) -> Result<(), ServiceError> {
        self.publish_with(|place| *place = *value)
    }
}

/// A subscriber of a service.
#[derive(Debug)]
pub struct ServiceSubscriber<T: ServicePayload> {
    port: Receiving<ipc::Service, T, SampleNumber>,
    /// The number of the next sample; `None` before the first.
    next: Option<u64>,
    lost: u32,
}

impl<T: ServicePayload> ServiceSubscriber<T> {
    /// Subscribes to the service of this run.
    ///
    /// # Errors
    /// If the service does not exist, or iceoryx2 refuses an operation.
    pub fn on(run: &RunName) -> Result<Self, ServiceError> {
        Self::on_node(&node()?, run)
    }

    pub(super) fn on_node(node: &Node<ipc::Service>, run: &RunName) -> Result<Self, ServiceError> {
        let builder = node.service_builder(&name_of::<T>(run)?);
        let builder = builder.publish_subscribe::<T>();
        let service = builder.user_header::<SampleNumber>().open();
        let port = service
            .map_err(refused(T::NAME))?
            .subscriber_builder()
            .create();
        Ok(Self {
            port: port.map_err(refused(T::NAME))?,
            next: None,
            lost: 0,
        })
    }
}

impl<T: ServicePayload> Subscribe<T> for ServiceSubscriber<T> {
    type View<'a> = T;

    fn take_with<R>(&mut self, mut read: impl FnMut(&T) -> R) -> Option<R> {
        let sample = self.port.receive().ok().flatten()?;
        let number = sample.user_header().number;
        // The count of a successor of the publisher begins at 0 again.
        let lost = number.saturating_sub(self.next.unwrap_or(number));
        self.lost = self.lost.wrapping_add(lost as u32);
        self.next = Some(number.wrapping_add(1));
        Some(read(&sample))
    }

    fn take(&mut self) -> Option<T> {
        self.take_with(|value| *value)
    }

    fn lost(&self) -> u32 {
        self.lost
    }
}
