// Forces of a ball's images, and the wrenches on their iron, in units of μ0/4π. The energy is half that of the ball and
// its image.
#pragma once
#include "near_contact/images.h"
#include "near_contact/sweeps.h"

namespace warpmag {

// Numbers of an image that ball i has in a slot, and lanes with one.
struct ImageSlot {
    int at[WIDTH];
    Mask live;
};
CUDA_CALLABLE inline ImageSlot image_slot(const NearArrays& a, const int* partner) {
    ImageSlot slot = {{}, mask_of(indices(partner) >= Index(a.balls))};
    for (int l = 0; l < WIDTH; ++l) slot.at[l] = partner[l] >= a.balls ? partner[l] - a.balls : 0;
    return slot;
}
// A row of the views of images.
CUDA_CALLABLE inline Number view_row(const NearArrays& a, const ImageSlot& slot, int row) {
    int at[WIDTH];
    for (int l = 0; l < WIDTH; ++l) at[l] = VIEW_ROWS * slot.at[l] + row;
    return gather(a.image_view, at);
}

// Scalar product of two quadrupoles and the torque on the first one, from a drive e_Θ.
CUDA_CALLABLE inline Number energy_of(Traceless t, Traceless e) {
    const Number product = t.xx * e.xx + t.yy * e.yy + (t.xx + t.yy) * (e.xx + e.yy);
    return Real(2.0 / 3.0) * (product + 2 * (t.xy * e.xy + t.yz * e.yz + t.zx * e.zx));
}
CUDA_CALLABLE inline Vector torque_of(Traceless t, Traceless e) {
    const Number tz = -t.xx - t.yy, ez = -e.xx - e.yy;
    const Number x = t.xy * e.zx + t.yy * e.yz + t.yz * ez - e.xy * t.zx - e.yy * t.yz - e.yz * tz;
    const Number y = t.zx * e.xx + t.yz * e.xy + tz * e.zx - e.zx * t.xx - e.yz * t.xy - ez * t.zx;
    const Number z = t.xx * e.xy + t.xy * e.yy + t.zx * e.yz - e.xx * t.xy - e.xy * t.yy - e.zx * t.yz;
    return Real(-4.0 / 3.0) * Vector{x, y, z};
}

// Torque of an image on its ball, and the energy of the two at fixed moments.
struct ImageAction {
    Vector torque;
    Number energy;
};
// Adds the action of sources: ``sum`` is their drive, and the field of the image's moment.
CUDA_CALLABLE inline ImageAction source_action(const Number (&sum)[16], const Sources& own) {
    const Vector e = {sum[5], sum[6], sum[7]}, field = {sum[8], sum[14], sum[15]};
    const Traceless gradient = {sum[0], sum[1], sum[2], sum[3], sum[4]};
    return {cross(e, own.t) + cross(own.m, field) + torque_of(own.theta, gradient),
            own.q * sum[13] + dot(own.t, e) + energy_of(own.theta, gradient) - dot(own.m, field)};
}
// The same of a contact: ``sum`` are the sources that the drive ``own`` of a ball of radius ``size`` makes there.
CUDA_CALLABLE inline ImageAction contact_action(const Number (&sum)[16], const Drive& own, Number size) {
    const Number inverse = 1 / size, square = inverse * inverse;
    const Vector e = inverse * own.e, dipole = {sum[5], sum[6], sum[7]};
    const Traceless theta = {sum[0], sum[1], sum[2], sum[3], sum[4]}, &t = own.t;
    const Traceless gradient = {square * t.xx, square * t.yy, square * t.xy, square * t.yz, square * t.zx};
    return {cross(e, dipole) + torque_of(theta, gradient),
            -(own.phi * sum[13]) - dot(e, dipole) - energy_of(theta, gradient)};
}

// Stores force and torque on balls by their images.
CUDA_CALLABLE inline void put_wrench(const NearArrays& a, const ImageSlot& slot, const int* partner, Vector force,
                                     Vector torque) {
    const Number rows[6] = {force.x, force.y, force.z, torque.x, torque.y, torque.z};
    for (int l = 0; l < WIDTH; ++l)
        for (int c = 0; c < 6 && partner[l] >= a.balls; ++c)
            a.image_wrench[6 * (size_t)slot.at[l] + c] = lane_of(rows[c], l);
}

// Completes the force of slot s if it holds an image: ``force`` is that of sources. Returns the force that an image
// adds to ``force`` and to the ball's own half of the contact.
CUDA_CALLABLE inline Vector image_force(const NearArrays& a, int i, int s, const int* partner, const Sources& own,
                                        Vector force, bool contact) {
    const ImageSlot slot = image_slot(a, partner);
    const Rows<PAIR_ROWS> row(a.pair(s, i));
    const Vector u = {row[0], row[1], row[2]};
    const Number size = numbers(a.radius + i), zero = size * Real(0);
    const Sources other = sources_at(a, partner);
    Number drive[16], made[16];
    for (int c = 0; c < 16; ++c) drive[c] = made[c] = zero;
    add_drive(drive, row, other);
    add_dipole_field(drive, row, other.m);
    ImageAction action = source_action(drive, own);
    // the weight is a factor of U_sr and of quadrupoles, and acts twice between charges and quadrupoles
    const Number mixed = own.q * dot(other.theta * u, u) + other.q * dot(own.theta * u, u);
    action.energy += Real(1.0 / 3.0) * row[7] * row[5] * mixed;
    Vector half = {zero, zero, zero};
    if (contact) {
        const Drive own_drive = drive_at(a, OwnIndices(i).at);
        add_contact_sources(a, made, Conductances(a.conductance(s, i)), u, size, own_drive, drive_at(a, partner));
        const ImageAction of_contact = contact_action(made, own_drive, size);
        action = {action.torque + of_contact.torque, action.energy + of_contact.energy};
        half = own_vector(a.pair_force(s, i));
    }
    const Vector mirrored = half - (2 * dot(half, u)) * u; // of the image's half
    const Number weight = view_row(a, slot, WEIGHT), faded = slot.live ? weight : zero + 1;
    const Vector slope = {view_row(a, slot, SLOPE), view_row(a, slot, SLOPE + 1), view_row(a, slot, SLOPE + 2)};
    const Vector added = mirrored - (Real(0.5) * action.energy / faded) * slope;
    put_wrench(a, slot, partner, force + added - half, action.torque);
    Vector result = {zero, zero, zero};
    add_where(slot.live, result, added);
    return result;
}
}
