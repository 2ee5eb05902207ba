//! What firmware logs has defmt's format.

fn has_format<T: defmt::Format>() {}

#[test]
fn errors_ids_states_and_events_have_a_format() {
    has_format::<tandem_board::Identity>();
    has_format::<tandem_board::Instant>();
    has_format::<tandem_board::CanFrame>();
    has_format::<tandem_board::FlashError>();
    has_format::<tandem_board::ResetCause>();
    has_format::<tandem_bus::ReceiveError>();
    has_format::<tandem_bus::RoleCode>();
    has_format::<tandem_redundancy::Action>();
    has_format::<tandem_redundancy::Input>();
    has_format::<tandem_redundancy::LinkReport>();
    has_format::<tandem_redundancy::SystemState>();
    has_format::<tandem_shm::incarnation::Incarnation>();
    has_format::<tandem_shm::map::MapError>();
    has_format::<tandem_shm::region::EndError>();
}
