/*
 * biped.c: a legged robot at 50 Hz in C, with two imported policies, one for standing and one for walking.
 *
 *     biped STAND.lads WALK.lads PERIODS
 *
 * The images are made by `lads import` and `lads compile`. The program gives raw sensor values and gets joint targets; order, scales,
 * default posture and the last action are the image's. The hardware is a stand-in: joints follow their targets slowly, every 40th read
 * of the sensors is lost, and half-way the robot begins to walk. Prints what the guard counted and a digest of all actions. The exit
 * status is 2 when something was refused. It does not wait for the clock: kitchen.c shows how.
 */
#define _POSIX_C_SOURCE 200809L

#include "files.h"

#include <lads.h>

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST = 128, LOST = 40 };

static const float MAX_RATE = 8.0F;

typedef struct {
    lads_policy policy;
    lads_controller *controller;
} loaded;

static int refuse(const char *thing, lads_status status) {
    fprintf(stderr, "biped: %s: status %d\n", thing, (int)status);
    return 2;
}

/* Opens an image, and sets a controller up that has passed its self-test. */
static lads_status load(const char *path, const lads_options *options, loaded *to) {
    size_t bytes = 0;
    const unsigned char *image = read_file(path, &bytes);
    lads_status status = lads_policy_open(image, bytes, &to->policy);
    if (status != LADS_STATUS_OK) {
        return status;
    }
    const size_t workspace_bytes = lads_workspace_bytes(&to->policy);
    void *workspace = lines(workspace_bytes);
    status = lads_controller_init(&to->policy, workspace, workspace_bytes, options, &to->controller, NULL);
    return status == LADS_STATUS_OK ? lads_self_test(to->controller, NULL) : status;
}

/* Whether a text is one of C. */
static int is(lads_text text, const char *wanted) {
    return text.len == strlen(wanted) && memcmp(text.data, wanted, text.len) == 0;
}

int main(int count, char **arguments) {
    static loaded stand, walk;
    static float sensors[MOST], action[MOST], rates[MOST];
    static size_t position[MOST], velocity[MOST];
    const float command[3] = {0.4F, 0.0F, 0.1F};
    lads_contract contract = {.struct_bytes = sizeof contract};
    lads_options options = {.struct_bytes = sizeof options};
    lads_report report = {.struct_bytes = sizeof report};
    lads_counters_t counters = {.struct_bytes = sizeof counters};
    lads_status status;
    uint32_t command_channel, digest = 0x811c9dc5U;
    if (count != 4) {
        fprintf(stderr, "biped: usage: biped STAND.lads WALK.lads PERIODS\n");
        return 2;
    }
    const long periods = strtol(arguments[3], NULL, 10);
    for (size_t i = 0; i < MOST; i++) {
        rates[i] = MAX_RATE;
    }
    options.fallback = LADS_FALLBACK_DECAY;
    options.decay_s = 0.2F;
    options.coast = 2;
    options.max_jump = 10; /* periods: further ahead, and a timestamp is damaged */
    options.max_rate = rates;
    if ((status = load(arguments[1], &options, &stand)) != LADS_STATUS_OK) {
        return refuse(arguments[1], status);
    }
    if ((status = load(arguments[2], &options, &walk)) != LADS_STATUS_OK) {
        return refuse(arguments[2], status);
    }
    lads_policy_contract(&stand.policy, &contract);
    lads_channel_t observed = {.struct_bytes = sizeof observed};
    lads_channel_t acted = {.struct_bytes = sizeof acted};
    if ((status = lads_channel_find(&stand.policy, "command", strlen("command"), &command_channel)) != LADS_STATUS_OK) {
        return refuse("the policy's channels", status);
    }
    lads_channel(&stand.policy, contract.observation, &observed);
    lads_channel(&stand.policy, contract.action, &acted);
    if (observed.len > MOST || acted.len > MOST) {
        return refuse("the policy is larger than this program", LADS_STATUS_OK);
    }
    /* Where each joint's position and velocity lie among the sensors, by name. */
    for (size_t joint = 0; joint < acted.len; joint++) {
        lads_element target = {.struct_bytes = sizeof target};
        lads_channel_element(&stand.policy, contract.action, joint, &target);
        for (size_t i = 0; i < observed.len; i++) {
            lads_element element = {.struct_bytes = sizeof element};
            lads_channel_element(&stand.policy, contract.observation, i, &element);
            if (element.joint.len == target.joint.len && memcmp(element.joint.data, target.joint.data, target.joint.len) == 0) {
                *(is(element.interface, "velocity") ? &velocity[joint] : &position[joint]) = i;
            }
            if (is(element.name, "projected_gravity.w")) {
                sensors[i] = 1.0F; /* upright */
            }
        }
    }
    lads_controller *running = stand.controller;
    for (long period = 0; period < periods; period++) {
        const lads_tick tick = {.struct_bytes = sizeof tick, .timestamp = (uint64_t)period + 1};
        if (period == periods / 2) {
            /* The last executed action, limits, rates and counters go over. */
            if ((status = lads_swap(running, walk.controller, &report)) != LADS_STATUS_OK) {
                return refuse("swap", status);
            }
            running = walk.controller;
        }
        const lads_input inputs[2] = {
            {.channel = contract.observation, .dtype = LADS_F32, .data = period % LOST == LOST - 1 ? NULL : sensors, .len = observed.len},
            {.channel = command_channel, .dtype = LADS_F32, .data = command, .len = 3},
        };
        status = lads_step_channels(running, inputs, 2, &tick, action, acted.len, &report);
        if (status != LADS_STATUS_OK) {
            printf("period %ld: status %d%s\n", period, (int)status, report.coasting ? ", the last action again" : "");
        }
        for (size_t joint = 0; joint < acted.len; joint++) {
            const float step = 0.25F * (action[joint] - sensors[position[joint]]);
            unsigned char bits[sizeof(float)];
            sensors[position[joint]] += step;
            sensors[velocity[joint]] = step / contract.control_period_s;
            memcpy(bits, &action[joint], sizeof bits);
            for (size_t i = 0; i < sizeof bits; i++) {
                digest = (digest ^ bits[i]) * 0x01000193U;
            }
        }
    }
    lads_counters(running, &counters);
    printf("%ld periods, %lu coasted\ndigest %08lx\n", periods, (unsigned long)counters.coasted, (unsigned long)digest);
    return 0;
}
