/* The safety code of opendbc (package opendbc, opendbc/safety), as a protected function of aftbed.
 *
 *     gcc -shared -fPIC -O2 -I SITE_PACKAGES -I aftbed/functions -o safety.so safety.c
 *
 * Request: u32 time in us; u8 direction (0 from the car, 1 to the car, 2 to be forwarded, 3 tick: no frame); u8 bus;
 * u32 address; u8 length; data. Reply: see `struct reply`. All little-endian.
 *
 * State. The code keeps it in variables of its own, some of them static in a function, so they cannot be listed. It is
 * all of .data and .bss of this library: what the linker puts between `__dso_handle`, which begins .data, and `_end`. An
 * instance is a copy of that, which is put in place for a call. There are pointers in it, which are others in each
 * process; so what is captured is the difference to the state behind `aft_init`: none of them changes, so theirs is 0.
 *
 * With -DLISTED_ONLY, what is captured is what declarations.h declares. A user who reads that header would take it
 * for the whole state. It is not: the times and counters of received frames are missing.
 */
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "aft.h"

#define EPS_FACTOR 73

static uint32_t now_us;
uint32_t microsecond_timer_get(void);
uint32_t microsecond_timer_get(void) { return now_us; }

#include "opendbc/safety/can.h"
#include "opendbc/safety/safety.h"

extern char __dso_handle[] __attribute__((visibility("hidden")));
extern char _end[] __attribute__((visibility("hidden")));

#define BEGIN (__dso_handle + sizeof(void *))
#define SIZE ((size_t)(_end - BEGIN))
#define PLACE(instance, variable) ((char *)(instance) + ((char *)&(variable) - BEGIN))

static char *initial; /* a copy of all variables, behind `set_safety_hooks` */

#ifdef LISTED_ONLY

struct part {
    void *at;
    size_t size;
};

#define PART(variable) {&(variable), sizeof(variable)}

static const struct part listed[] = {
    PART(controls_allowed),   PART(relay_malfunction),     PART(gas_pressed),
    PART(gas_pressed_prev),   PART(brake_pressed),         PART(brake_pressed_prev),
    PART(regen_braking),      PART(regen_braking_prev),    PART(steering_disengage),
    PART(cruise_engaged_prev), PART(steering_disengage_prev), PART(vehicle_speed),
    PART(vehicle_moving),     PART(acc_main_on),           PART(cruise_button_prev),
    PART(safety_rx_checks_invalid), PART(desired_torque_last), PART(rt_torque_last),
    PART(valid_steer_req_count), PART(invalid_steer_req_count), PART(torque_meas),
    PART(torque_driver),      PART(ts_torque_check_last),  PART(ts_steer_req_mismatch_last),
    PART(heartbeat_engaged),  PART(heartbeat_engaged_mismatches), PART(rt_angle_msgs),
    PART(ts_angle_check_last), PART(desired_angle_last),   PART(angle_meas),
    PART(alternative_experience), PART(safety_mode_cnt),   PART(current_safety_mode),
    PART(current_safety_param),
};
#define LISTED (sizeof listed / sizeof *listed)

#endif

enum direction { FROM_CAR, TO_CAR, FORWARDED, TICK };

struct request {
    uint32_t time_us;
    uint8_t direction, bus;
    uint32_t address;
    uint8_t length;
} __attribute__((packed));

struct reply {
    int8_t answer; /* 1 valid or allowed, 0 not; of one to be forwarded: the bus, or -1 */
    uint8_t controls_allowed, rx_checks_invalid, relay_malfunction;
    int32_t torque_last;
} __attribute__((packed));

int aft_init(void **instance) {
    if (!initial) {
        if (!(initial = malloc(SIZE)) || set_safety_hooks(SAFETY_TOYOTA, EPS_FACTOR) != 0) return -1;
        memcpy(initial, BEGIN, SIZE);
    }
    if (!(*instance = malloc(SIZE))) return -1;
    memcpy(*instance, initial, SIZE);
    return AFT_OK;
}

void aft_end(void *instance) { free(instance); }

int aft_execute(void *instance, const uint8_t *request, size_t request_size, uint8_t *reply, size_t reply_max,
                size_t *reply_size) {
    struct request asked;
    CANPacket_t frame;
    uint8_t code = 0;
    (void)reply_max;
    if (request_size < sizeof asked) return AFT_REFUSED;
    memcpy(&asked, request, sizeof asked);
    while (code < sizeof dlc_to_len && dlc_to_len[code] != asked.length) code++;
    if (code == sizeof dlc_to_len || request_size != sizeof asked + asked.length || asked.direction > TICK ||
        asked.bus > 2 || asked.address > 0x1FFFFFFF)
        return AFT_REFUSED;
    memset(&frame, 0, sizeof frame);
    frame.bus = asked.bus;
    frame.addr = asked.address;
    frame.extended = asked.address >= 0x800;
    frame.data_len_code = code;
    memcpy(frame.data, request + sizeof asked, asked.length);

    memcpy(BEGIN, instance, SIZE);
    now_us = asked.time_us;
    struct reply answer = {0};
    switch (asked.direction) {
    case FROM_CAR: answer.answer = safety_rx_hook(&frame); break;
    case TO_CAR: answer.answer = safety_tx_hook(&frame); break;
    case FORWARDED: answer.answer = (int8_t)safety_fwd_hook(asked.bus, (int)asked.address); break;
    case TICK:
        safety_mode_cnt++;
        safety_tick(&current_safety_config);
        break;
    }
    answer.controls_allowed = controls_allowed;
    answer.rx_checks_invalid = safety_rx_checks_invalid;
    answer.relay_malfunction = relay_malfunction;
    answer.torque_last = desired_torque_last;
    memcpy(instance, BEGIN, SIZE);
    memcpy(reply, &answer, *reply_size = sizeof answer);
    return AFT_OK;
}

#ifdef LISTED_ONLY

int64_t aft_state_size(void *instance) {
    int64_t size = 0;
    (void)instance;
    for (size_t i = 0; i < LISTED; i++) size += (int64_t)listed[i].size;
    return size;
}

int aft_capture(void *instance, uint8_t *state, size_t state_size) {
    (void)state_size;
    for (size_t i = 0; i < LISTED; state += listed[i++].size)
        memcpy(state, PLACE(instance, *(char *)listed[i].at), listed[i].size);
    return AFT_OK;
}

int aft_restore(void *instance, const uint8_t *state, size_t state_size) {
    if ((int64_t)state_size != aft_state_size(instance)) return AFT_REFUSED;
    for (size_t i = 0; i < LISTED; state += listed[i++].size)
        memcpy(PLACE(instance, *(char *)listed[i].at), state, listed[i].size);
    return AFT_OK;
}

#else

int64_t aft_state_size(void *instance) {
    (void)instance;
    return (int64_t)SIZE;
}

int aft_capture(void *instance, uint8_t *state, size_t state_size) {
    for (size_t i = 0; i < state_size; i++) state[i] = ((uint8_t *)instance)[i] ^ (uint8_t)initial[i];
    return AFT_OK;
}

int aft_restore(void *instance, const uint8_t *state, size_t state_size) {
    if (state_size != SIZE) return AFT_REFUSED;
    for (size_t i = 0; i < SIZE; i++) ((uint8_t *)instance)[i] = state[i] ^ (uint8_t)initial[i];
    return AFT_OK;
}

#endif
